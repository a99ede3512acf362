//! The images of a recording in either form: plain, as Relief records them, or compressed by another node.

use depth_camera::Image;

use crate::{
    contents::Channel,
    messages::{CompressedMessage, Encoding, ImageError, ImageMessage},
};

/// How an image is packed into its message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// `sensor_msgs/Image`.
    Plain,
    /// `sensor_msgs/CompressedImage`.
    Compressed,
}

impl Form {
    /// That of a channel's messages; `None` if they are no images.
    pub fn of(channel: &Channel) -> Option<Self> {
        if channel.carries_sensor_msg("Image") {
            return Some(Form::Plain);
        }
        let is_compressed = channel.carries_sensor_msg("CompressedImage");
        is_compressed.then_some(Form::Compressed)
    }
}

/// An image message whose pixels have not been looked at.
pub enum PackedImage<'a> {
    /// A plain one.
    Plain(ImageMessage<'a>),
    /// A compressed one.
    Compressed(CompressedMessage<'a>),
}

/// The pixels of an image.
pub enum Pixels {
    /// Values of 16 bits.
    U16(Image<u16>),
    /// Depth in metres; what is not positive and finite is none.
    Metres(Image<f32>),
}

impl<'a> PackedImage<'a> {
    /// Reads and checks a message.
    ///
    /// # Errors
    /// [`ImageError`] with the value and its bound.
    pub fn decode(form: Form, message: &'a [u8]) -> Result<Self, ImageError> {
        Ok(match form {
            Form::Plain => PackedImage::Plain(ImageMessage::decode(message)?),
            Form::Compressed => PackedImage::Compressed(CompressedMessage::decode(message)?),
        })
    }

    /// How pixels are stored.
    pub fn encoding(&self) -> Encoding {
        match self {
            PackedImage::Plain(image) => image.encoding,
            PackedImage::Compressed(image) => image.encoding,
        }
    }

    /// Columns and rows.
    pub fn size(&self) -> (usize, usize) {
        match self {
            PackedImage::Plain(image) => (image.width, image.height),
            PackedImage::Compressed(image) => (image.width, image.height),
        }
    }

    /// The pixels, unpacked.
    ///
    /// # Errors
    /// [`ImageError::Compressed`].
    pub fn pixels(&self) -> Result<Pixels, ImageError> {
        let (width, height) = self.size();
        let is_depth_m = self.encoding() == Encoding::F32;
        Ok(match self {
            PackedImage::Plain(image) if is_depth_m => {
                Pixels::Metres(Image::from_vec(width, height, image.f32_pixels()))
            }
            PackedImage::Plain(image) => {
                Pixels::U16(Image::from_vec(width, height, image.u16_pixels()))
            }
            PackedImage::Compressed(image) if is_depth_m => {
                Pixels::Metres(image.values()?.map(|&value| image.depth_m(value)))
            }
            PackedImage::Compressed(image) => Pixels::U16(image.values()?),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_told_by_the_names_of_either_ros_and_of_no_other_package() {
        for (name, expected) in [
            ("sensor_msgs/msg/Image", Some(Form::Plain)),
            ("sensor_msgs/Image", Some(Form::Plain)),
            ("sensor_msgs/msg/CompressedImage", Some(Form::Compressed)),
            ("sensor_msgs/msg/CameraInfo", None),
            ("other_msgs/msg/Image", None),
            ("", None),
        ] {
            let channel = Channel {
                topic: "/image".to_owned(),
                message_type: name.to_owned(),
                encoding: "cdr".to_owned(),
            };
            assert_eq!(Form::of(&channel), expected, "{name}");
        }
    }
}
