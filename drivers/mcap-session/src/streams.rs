//! The streams of a recording: which topic carries what, in which message.

/// One stream of a recording. The order is that of the channels in every segment, whose numbers begin with 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stream {
    /// The camera's description: the text of a `session.toml`.
    Session,
    /// Depth images in the units that the description names.
    Depth,
    /// The camera of the depth images.
    DepthInfo,
    /// IR images in raw counts.
    Infrared,
    /// The camera of the IR images.
    InfraredInfo,
    /// The camera's pose, world from camera.
    Pose,
    /// What happened, in JSON.
    Events,
    /// The recorder's counters once a second, in JSON.
    Stats,
}

/// The definition of a message in the language of ROS 2, with those it refers to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Schema {
    /// The type's name.
    pub name: &'static str,
    /// Its definition.
    pub text: &'static str,
}

/// `sensor_msgs/Image`.
pub const IMAGE: Schema = Schema {
    name: "sensor_msgs/msg/Image",
    text: include_str!("msg/Image.msg"),
};
/// `sensor_msgs/CameraInfo`.
pub const CAMERA_INFO: Schema = Schema {
    name: "sensor_msgs/msg/CameraInfo",
    text: include_str!("msg/CameraInfo.msg"),
};
/// `geometry_msgs/PoseStamped`.
pub const POSE: Schema = Schema {
    name: "geometry_msgs/msg/PoseStamped",
    text: include_str!("msg/PoseStamped.msg"),
};
/// `std_msgs/String`.
pub const STRING: Schema = Schema {
    name: "std_msgs/msg/String",
    text: include_str!("msg/String.msg"),
};

impl Stream {
    /// All streams, in the order of their channels.
    pub const ALL: [Stream; 8] = [
        Stream::Session,
        Stream::Depth,
        Stream::DepthInfo,
        Stream::Infrared,
        Stream::InfraredInfo,
        Stream::Pose,
        Stream::Events,
        Stream::Stats,
    ];

    /// The end of the topic's name.
    pub fn suffix(self) -> &'static str {
        match self {
            Stream::Session => "/session",
            Stream::Depth => "/depth/image",
            Stream::DepthInfo => "/depth/camera_info",
            Stream::Infrared => "/ir/image",
            Stream::InfraredInfo => "/ir/camera_info",
            Stream::Pose => "/pose",
            Stream::Events => "/events",
            Stream::Stats => "/stats",
        }
    }

    /// The topic of a device's stream: `/k/<serial>` and the suffix.
    pub fn topic(self, serial: &str) -> String {
        format!("/k/{}{}", topic_token(serial), self.suffix())
    }

    /// The stream that a topic of a recording carries.
    pub fn of_topic(topic: &str) -> Option<Self> {
        let inside = topic.strip_prefix("/k/")?;
        let (_, suffix) = inside.split_at(inside.find('/')?);
        Self::ALL
            .into_iter()
            .find(|stream| stream.suffix() == suffix)
    }

    /// The message that the stream carries.
    pub fn schema(self) -> Schema {
        match self {
            Stream::Depth | Stream::Infrared => IMAGE,
            Stream::DepthInfo | Stream::InfraredInfo => CAMERA_INFO,
            Stream::Pose => POSE,
            Stream::Session | Stream::Events | Stream::Stats => STRING,
        }
    }
}

/// A serial number as ROS allows it in a name: letters, digits and underscores, no digit first.
fn topic_token(serial: &str) -> String {
    let digit_first = serial.starts_with(|c: char| c.is_ascii_digit());
    let letters = serial.chars().map(|c| match c.is_ascii_alphanumeric() {
        true => c,
        false => '_',
    });
    let prefix = if digit_first || serial.is_empty() {
        "s"
    } else {
        ""
    };
    prefix.chars().chain(letters).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_name_their_stream_whatever_the_serial() {
        for serial in ["012345678", "A00-36/5 é", "", "simulated-1"] {
            for stream in Stream::ALL {
                let topic = stream.topic(serial);
                assert_eq!(Stream::of_topic(&topic), Some(stream), "{topic}");
                let is_legal = |part: &str| {
                    part.starts_with(|c: char| c.is_ascii_alphabetic())
                        && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
                };
                assert!(topic.split('/').skip(1).all(is_legal), "{topic}");
            }
        }
        assert_eq!(Stream::Depth.topic("0123"), "/k/s0123/depth/image");
        assert_eq!(Stream::of_topic("/camera/depth/image"), None);
        assert_eq!(Stream::of_topic("/k/session"), None);
    }
}
