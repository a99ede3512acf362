//! Bags that other ROS 2 nodes recorded: which of their topics are depth and IR of one camera.
//!
//! Depth is an image in `16UC1` (millimetres, as ROS has it) or `32FC1` (metres); IR is one in `mono16`, or in `16UC1` on a topic
//! named for it; both of one size, with a `CameraInfo` beside them. What is there in both forms is read where it is not compressed.
//! 512×424 pixels are a Kinect II with its emitter; other sizes are taken for structured light, whose IR without a known lamp is of
//! no use here and is left out.

use std::{collections::BTreeMap, path::Path};

use depth_camera::{CameraError, CameraInfo, Intrinsics, Light, Sensor};
use replay::DepthScale;

use crate::{
    contents::Channel,
    images::{Form, PackedImage},
    messages::{CameraInfoMessage, Encoding, ImageError, PLUMB_BOB},
    plan::Plan,
};

/// ROS has depth of 16 bits in millimetres.
const UNITS_PER_METRE: f64 = 1000.0;
/// Full scale of 16-bit IR.
const IR_FULL_SCALE: f64 = 65_535.0;
/// The images of a Kinect II.
const KINECT2_SIZE: (usize, usize) = (512, 424);

/// The first message of every topic that matters.
#[derive(Clone, Debug, Default)]
pub struct Bag {
    images: BTreeMap<String, Result<Seen, String>>,
    infos: BTreeMap<String, CameraInfoMessage>,
}

/// What an image topic carries.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Seen {
    form: Form,
    encoding: Encoding,
    size: (usize, usize),
}

impl Seen {
    fn of(form: Form, message: &[u8]) -> Result<Self, ImageError> {
        let image = PackedImage::decode(form, message)?;
        Ok(Seen {
            form,
            encoding: image.encoding(),
            size: image.size(),
        })
    }
}

impl Bag {
    /// Looks at a message.
    pub fn see(&mut self, channel: &Channel, message: &[u8]) {
        let topic = &channel.topic;
        if let Some(form) = Form::of(channel)
            && !self.images.contains_key(topic)
        {
            let seen = match channel.encoding.as_str() {
                "cdr" => Seen::of(form, message).map_err(|error| error.to_string()),
                other => Err(format!("encoding \"{other}\" of messages, must be cdr")),
            };
            self.images.insert(topic.clone(), seen);
        }
        if channel.carries_sensor_msg("CameraInfo")
            && !self.infos.contains_key(topic)
            && let Ok(info) = CameraInfoMessage::decode(message)
        {
            self.infos.insert(topic.clone(), info);
        }
    }
}

/// Which topics of a bag are the camera's.
///
/// # Errors
/// [`CameraError::Invalid`] naming the topics that were found and what is missing or too many.
pub fn plan(path: &Path, bag: &Bag) -> Result<Plan, CameraError> {
    choose(path, bag).map_err(|what| CameraError::Invalid(format!("{}: {what}", path.display())))
}

fn choose(path: &Path, bag: &Bag) -> Result<Plan, String> {
    let images: Vec<(&String, Seen)> = bag
        .images
        .iter()
        .filter_map(|(topic, seen)| Some((topic, *seen.as_ref().ok()?)))
        .collect();
    let is_depth = |(topic, seen): &&(&String, Seen)| match seen.encoding {
        Encoding::F32 => true,
        Encoding::U16 => !is_named_infrared(topic),
        Encoding::Mono16 => false,
    };
    let depth = plain_first(images.iter().filter(is_depth).copied().collect());
    let [(depth_topic, depth)] = depth.as_slice() else {
        return Err(match depth.is_empty() {
            true => format!(
                "no topic with depth images in 16UC1 or 32FC1; {}",
                found(bag)
            ),
            false => format!(
                "several topics with depth images, must be one: {}",
                names(depth.iter().map(|(topic, _)| topic.as_str()))
            ),
        });
    };
    let intrinsics = intrinsics(bag, depth_topic, depth.size)?;
    let sensor = match depth.size == KINECT2_SIZE {
        true => Sensor::Kinect2,
        false => Sensor::Kinect1,
    };
    let is_infrared = |(topic, seen): &&(&String, Seen)| {
        let brightness = match seen.encoding {
            Encoding::Mono16 => true,
            Encoding::U16 => is_named_infrared(topic),
            Encoding::F32 => false,
        };
        brightness && seen.size == depth.size && is_rectified(topic) == is_rectified(depth_topic)
    };
    let infrared = plain_first(images.iter().filter(is_infrared).copied().collect());
    let infrared_topic = match (sensor, infrared.as_slice()) {
        (Sensor::Kinect1, _) | (_, []) => None,
        (Sensor::Kinect2, [(topic, _)]) => Some((*topic).clone()),
        (Sensor::Kinect2, several) => {
            return Err(format!(
                "several topics with IR images, must be one: {}",
                names(several.iter().map(|(topic, _)| topic.as_str()))
            ));
        }
    };
    let with_infrared = infrared_topic.is_some();
    let name = path.file_stem().unwrap_or(path.as_os_str());
    Ok(Plan {
        info: CameraInfo {
            sensor,
            serial: name.to_string_lossy().into_owned(),
            driver: None,
            intrinsics,
            ir_full_scale: with_infrared.then_some(IR_FULL_SCALE),
            light: with_infrared.then(Light::kinect2_emitter),
            n_frames: None,
            ir_gain: None,
        },
        depth_topic: (*depth_topic).clone(),
        infrared_topic,
        depth_scale: DepthScale {
            units_per_metre: UNITS_PER_METRE,
        },
        is_numbered: false,
    })
}

/// Of topics those that are not compressed, if there are any: image_transport offers one image in both forms.
fn plain_first(topics: Vec<(&String, Seen)>) -> Vec<(&String, Seen)> {
    let is_plain = |(_, seen): &&(&String, Seen)| seen.form == Form::Plain;
    let plain: Vec<_> = topics.iter().filter(is_plain).copied().collect();
    if plain.is_empty() { topics } else { plain }
}

/// The camera whose topic shares most with that of the images.
fn intrinsics(bag: &Bag, topic: &str, size: (usize, usize)) -> Result<Intrinsics, String> {
    let of_size = bag
        .infos
        .iter()
        .filter(|(_, info)| (info.width as usize, info.height as usize) == size);
    let (info_topic, info) = of_size
        .max_by_key(|(info_topic, _)| n_shared_names(info_topic, topic))
        .ok_or_else(|| {
            format!(
                "no CameraInfo of {}×{} pixels for {topic}; {}",
                size.0,
                size.1,
                found(bag)
            )
        })?;
    let intrinsics = match is_rectified(topic) {
        true => rectified(info),
        false => raw(info).map_err(|what| format!("{info_topic}: {what}"))?,
    };
    let (fx, fy) = (intrinsics.fx, intrinsics.fy);
    let is_good = |focal: f64| focal.is_finite() && focal > 0.0;
    if !is_good(fx) || !is_good(fy) {
        return Err(format!(
            "{info_topic}: focal lengths {fx} and {fy}, must be positive; the camera was not calibrated"
        ));
    }
    Ok(intrinsics)
}

/// The camera of the images as taken.
fn raw(info: &CameraInfoMessage) -> Result<Intrinsics, String> {
    let d = match (info.distortion_model.as_str(), info.d.as_slice()) {
        (_, []) => [0.0; 5],
        (PLUMB_BOB, &[k1, k2, p1, p2]) => [k1, k2, p1, p2, 0.0],
        (PLUMB_BOB | "rational_polynomial", &[k1, k2, p1, p2, k3, ref rest @ ..])
            if rest.iter().all(|&k| k == 0.0) =>
        {
            [k1, k2, p1, p2, k3]
        }
        (model, d) => {
            return Err(format!(
                "distortion model \"{model}\" with coefficients {d:?}, must be {PLUMB_BOB} with k1 k2 p1 p2 k3"
            ));
        }
    };
    if !d.iter().all(|k| k.is_finite()) {
        return Err(format!("distortion {d:?}, must be finite"));
    }
    let [fx, _, cx, _, fy, cy, ..] = info.k;
    Ok(camera(info, [fx, fy, cx, cy], d))
}

/// The camera of the rectified images, which has no distortion.
fn rectified(info: &CameraInfoMessage) -> Intrinsics {
    let [fx, _, cx, _, _, fy, cy, ..] = info.p;
    camera(info, [fx, fy, cx, cy], [0.0; 5])
}

fn camera(info: &CameraInfoMessage, [fx, fy, cx, cy]: [f64; 4], d: [f64; 5]) -> Intrinsics {
    let [k1, k2, p1, p2, k3] = d;
    Intrinsics {
        width: info.width as usize,
        height: info.height as usize,
        fx,
        fy,
        cx,
        cy,
        k1,
        k2,
        p1,
        p2,
        k3,
    }
}

/// Names that two topics begin with.
fn n_shared_names(a: &str, b: &str) -> usize {
    let pairs = a.split('/').zip(b.split('/'));
    pairs.take_while(|(a, b)| a == b).count()
}

/// Whether a topic's name says that it is IR.
fn is_named_infrared(topic: &str) -> bool {
    topic
        .split(['/', '_'])
        .any(|word| word == "ir" || word.starts_with("infra"))
}

/// Whether a topic's name says that its images are rectified.
fn is_rectified(topic: &str) -> bool {
    topic.split(['/', '_']).any(|word| word.starts_with("rect"))
}

/// What image topics there are.
fn found(bag: &Bag) -> String {
    if bag.images.is_empty() {
        return "there are no image topics".to_owned();
    }
    let said = bag.images.iter().map(|(topic, seen)| match seen {
        Ok(seen) => format!(
            "{topic} ({}{}, {}×{})",
            seen.encoding.name(),
            match seen.form {
                Form::Plain => "",
                Form::Compressed => " compressed",
            },
            seen.size.0,
            seen.size.1
        ),
        Err(what) => format!("{topic} ({what})"),
    });
    format!("found {}", said.collect::<Vec<_>>().join(", "))
}

fn names<'a>(topics: impl Iterator<Item = &'a str>) -> String {
    topics.collect::<Vec<_>>().join(", ")
}
