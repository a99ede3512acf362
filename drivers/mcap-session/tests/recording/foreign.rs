//! Bags of other nodes.

use std::{
    collections::BTreeMap,
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
};

use depth_camera::{DepthCamera, Image, Intrinsics, Light, Sensor};
use mcap::{Compression, WriteOptions, records::MessageHeader};
use mcap_session::{
    McapCamera,
    messages::{CameraInfoMessage, Encoding, Header, Stamp, encode_image},
    streams::{CAMERA_INFO, IMAGE, Schema},
};

use crate::support::play;

/// Topic, type, time of the header in nanoseconds, and the message.
type Entry = (&'static str, Schema, i64, Vec<u8>);

fn write_bag(folder: &Path, options: WriteOptions, entries: &[Entry]) -> PathBuf {
    let path = folder.join("bag.mcap");
    let file = BufWriter::new(File::create(&path).unwrap());
    let mut writer = options.profile("ros2").create(file).unwrap();
    for (n, (topic, schema, time_ns, message)) in entries.iter().enumerate() {
        let text = schema.text.as_bytes();
        let schema = writer.add_schema(schema.name, "ros2msg", text).unwrap();
        let channel = writer.add_channel(schema, topic, "cdr", &BTreeMap::new());
        let header = MessageHeader {
            channel_id: channel.unwrap(),
            // rosbag2 leaves it at 0.
            sequence: 0,
            // When the bag's writer had it, some time later.
            log_time: (1_700_000_000_000_000_000 + time_ns) as u64 + 7_000_000 * (n as u64 % 3),
            publish_time: 0,
        };
        writer.write_to_known_channel(&header, message).unwrap();
    }
    writer.finish().unwrap();
    path
}

fn zstd() -> WriteOptions {
    WriteOptions::new().compression(Some(Compression::Zstd))
}

fn header(time_ns: i64) -> Header {
    Header {
        stamp: Stamp(time_ns),
        frame_id: "camera".to_owned(),
    }
}

fn image(
    topic: &'static str,
    encoding: Encoding,
    (width, height): (usize, usize),
    time_ns: i64,
    value: u16,
) -> Entry {
    let pixels = vec![value; width * height];
    let message = encode_image(&header(time_ns), encoding, width, pixels.into_iter());
    (topic, IMAGE, time_ns, message)
}

fn info(topic: &'static str, (width, height): (usize, usize), d: Vec<f64>) -> Entry {
    let intrinsics = Intrinsics {
        width,
        height,
        fx: 366.0,
        fy: 366.5,
        cx: 255.5,
        cy: 211.5,
        k1: 0.0,
        k2: 0.0,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    };
    let mut message = CameraInfoMessage::of_intrinsics(header(0), &intrinsics);
    message.d = d;
    message.p[0] = 350.0;
    message.p[5] = 350.0;
    (topic, CAMERA_INFO, 0, message.encode())
}

const KINECT2: (usize, usize) = (512, 424);

fn kinect2_bag() -> Vec<Entry> {
    let mut entries = vec![info(
        "/k2/sd/camera_info",
        KINECT2,
        vec![0.1, -0.2, 0.0, 0.0, 0.3],
    )];
    for n in 0..4 {
        let time_ns = 5_000_000_000 + 33_333_333 * n;
        let value = 1000 + n as u16;
        entries.push(image(
            "/k2/sd/image_ir",
            Encoding::U16,
            KINECT2,
            time_ns + 4_000_000,
            value,
        ));
        entries.push(image(
            "/k2/sd/image_depth",
            Encoding::U16,
            KINECT2,
            time_ns,
            value,
        ));
    }
    // IR alone at the end.
    entries.push(image(
        "/k2/sd/image_ir",
        Encoding::U16,
        KINECT2,
        6_000_000_000,
        9,
    ));
    entries
}

#[test]
fn a_kinect2_node_gives_millimetres_and_its_emitter() {
    let folder = tempfile::tempdir().unwrap();
    for options in [zstd(), zstd().compression(None), zstd().use_chunks(false)] {
        let path = write_bag(folder.path(), options, &kinect2_bag());
        let camera = McapCamera::open(&path).unwrap();
        let found = camera.info();
        assert_eq!((found.sensor, found.n_frames), (Sensor::Kinect2, None));
        assert_eq!(found.light, Some(Light::kinect2_emitter()));
        assert_eq!(found.ir_full_scale, Some(65_535.0));
        assert_eq!((found.intrinsics.fx, found.intrinsics.k3), (366.0, 0.3));

        let played = play(&path).unwrap();
        assert_eq!(played.damages, Vec::<String>::new());
        assert_eq!(played.frames.len(), 5);
        for (frame, n) in played.frames.iter().zip(0u16..4) {
            assert_eq!(frame.frame_id, u64::from(n));
            let secs = 5.0 + 33_333_333e-9 * f64::from(n);
            assert!((frame.device_time_secs - secs).abs() < 1e-9);
            let depth = frame.depth.as_ref().unwrap();
            assert_eq!(*depth.at(3, 4), (f64::from(1000 + n) / 1000.0) as f32);
            assert_eq!(*frame.ir.as_ref().unwrap().at(3, 4), 1000 + n);
        }
        let last = &played.frames[4];
        assert!(last.depth.is_none() && last.ir.is_some());
    }
}

#[test]
fn images_of_one_time_are_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let depth = |time_ns| image("/k2/sd/image_depth", Encoding::U16, KINECT2, time_ns, 900);
    let entries = [
        info("/k2/sd/camera_info", KINECT2, vec![]),
        depth(0),
        depth(0),
        depth(0),
        depth(1_500_000_000),
        depth(1_500_000_000),
    ];
    let path = write_bag(folder.path(), zstd(), &entries);
    let played = play(&path).unwrap();
    assert_eq!(played.frames.len(), 2);
    // The bag's writer puts two images into a chunk.
    let expected = [
        "an image of 0.000000000 s, which a later one has too; 1 more of the chunk are lost",
        "an image of 1.500000000 s, which a later one has too",
    ];
    let path = path.display();
    assert_eq!(
        played.damages,
        expected.map(|what| format!("{path}: /k2/sd/image_depth: {what}"))
    );
}

#[test]
fn a_chunk_of_more_messages_than_it_can_hold_images_fills_no_memory() {
    let folder = tempfile::tempdir().unwrap();
    let depth = |size, time_ns| image("/k2/sd/image_depth", Encoding::U16, size, time_ns, 900);
    let mut entries = vec![
        info("/k2/sd/camera_info", KINECT2, vec![]),
        depth(KINECT2, 0),
    ];
    // All but five have room.
    entries.extend((1..(1 << 13) + 5).map(|n| depth((1, 1), n)));
    let options = zstd().chunk_size(Some(64 << 20));
    let path = write_bag(folder.path(), options, &entries);
    let damages = play(&path).unwrap().damages;
    let is_told = |damage: &&String| {
        damage.ends_with("more than 8192 images wait for their place; 4 more of the chunk are lost")
    };
    assert_eq!(damages.iter().filter(is_told).count(), 1);
}

#[test]
fn of_several_infrared_images_near_depth_the_nearest_goes_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let infrared = |ms: i64, value| {
        let time_ns = ms * 1_000_000;
        image("/k2/sd/image_ir", Encoding::U16, KINECT2, time_ns, value)
    };
    let depth = |ms: i64| {
        image(
            "/k2/sd/image_depth",
            Encoding::U16,
            KINECT2,
            ms * 1_000_000,
            9,
        )
    };
    let entries = [
        info("/k2/sd/camera_info", KINECT2, vec![]),
        infrared(991, 1),
        infrared(995, 2),
        depth(1000),
        infrared(1003, 3),
        infrared(1006, 4),
        depth(1033),
    ];
    let path = write_bag(folder.path(), zstd(), &entries);
    let played = play(&path).unwrap();
    assert_eq!(played.damages, Vec::<String>::new());
    let found = played.frames.iter().map(|frame| {
        let value = frame.ir.as_ref().map(|ir| *ir.at(0, 0));
        let ms = (1000.0 * frame.device_time_secs).round() as u32;
        (ms, frame.depth.is_some(), value)
    });
    assert_eq!(
        found.collect::<Vec<_>>(),
        [
            (991, false, Some(1)),
            (995, false, Some(2)),
            (1000, true, Some(3)),
            (1006, false, Some(4)),
            (1033, true, None),
        ]
    );
}

#[test]
fn rectified_images_have_the_rectified_camera() {
    let folder = tempfile::tempdir().unwrap();
    let entries = [
        info(
            "/k2/sd/camera_info",
            KINECT2,
            vec![0.1, -0.2, 0.0, 0.0, 0.3],
        ),
        image("/k2/sd/image_depth_rect", Encoding::U16, KINECT2, 0, 900),
        image("/k2/sd/image_ir", Encoding::Mono16, KINECT2, 0, 900),
        image("/k2/sd/image_ir_rect", Encoding::Mono16, KINECT2, 0, 901),
    ];
    let path = write_bag(folder.path(), zstd(), &entries);
    let camera = McapCamera::open(&path).unwrap();
    let i = camera.info().intrinsics;
    assert_eq!((i.fx, i.k1), (350.0, 0.0));
    let played = play(&path).unwrap();
    assert_eq!(*played.frames[0].ir.as_ref().unwrap().at(0, 0), 901);
}

/// Depth in metres, as depth_image_proc gives it.
fn float_depth(topic: &'static str, (width, height): (usize, usize), metres: f32) -> Entry {
    // The layout is that of 16 bits but for encoding, step and data: made by hand, so that the reader is not tested against
    // its own writer.
    let mut message = vec![0, 1, 0, 0];
    message.extend(1i32.to_le_bytes());
    message.extend(0u32.to_le_bytes());
    message.extend([2, 0, 0, 0, b'c', 0, 0, 0]);
    message.extend((height as u32).to_le_bytes());
    message.extend((width as u32).to_le_bytes());
    message.extend([6, 0, 0, 0]);
    message.extend(b"32FC1\0");
    message.extend([0, 0]);
    message.extend((4 * width as u32).to_le_bytes());
    message.extend((4 * (width * height) as u32).to_le_bytes());
    for n in 0..width * height {
        let value = if n == 0 { f32::NAN } else { metres };
        message.extend(value.to_le_bytes());
    }
    (topic, IMAGE, 0, message)
}

#[test]
fn depth_in_metres_of_another_camera_is_read_without_its_infrared() {
    let folder = tempfile::tempdir().unwrap();
    let size = (640, 480);
    let entries = [
        info("/other/camera_info", size, vec![0.5; 5]),
        info("/camera/depth/camera_info", size, vec![]),
        float_depth("/camera/depth/image", size, 1.25),
        image("/camera/ir/image", Encoding::Mono16, size, 1_000_000_000, 7),
    ];
    let path = write_bag(folder.path(), zstd(), &entries);
    let camera = McapCamera::open(&path).unwrap();
    assert_eq!(camera.info().sensor, Sensor::Kinect1);
    assert_eq!(camera.info().ir_full_scale, None);
    assert_eq!(camera.info().intrinsics.k1, 0.0);
    let played = play(&path).unwrap();
    assert_eq!(played.frames.len(), 1);
    let depth = played.frames[0].depth.as_ref().unwrap();
    assert_eq!(depth.data()[..2], [0.0, 1.25]);
    assert!(played.frames[0].ir.is_none());
}

const COMPRESSED: Schema = Schema {
    name: "sensor_msgs/msg/CompressedImage",
    text: "std_msgs/Header header\nstring format\nuint8[] data",
};

/// An image as a plugin of image_transport compresses it: `head`, and a PNG whose pixels count from 0 to 1499, over and over.
fn compressed(topic: &'static str, format: &str, head: &[u8]) -> Entry {
    let (width, height) = KINECT2;
    let values = (0..width * height).map(|pixel| (pixel % 1500) as u16);
    let values = Image::from_vec(width, height, values.collect());
    let folder = tempfile::tempdir().unwrap();
    let png = folder.path().join("values.png");
    replay::write_png(&png, &values, replay::PngEffort::Live).unwrap();
    let data = [head, &std::fs::read(png).unwrap()].concat();
    let mut message = vec![0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    message.extend([2, 0, 0, 0, b'c', 0, 0, 0]);
    message.extend((format.len() as u32 + 1).to_le_bytes());
    message.extend(format.as_bytes());
    message.push(0);
    message.resize(message.len().next_multiple_of(4), 0);
    message.extend((data.len() as u32).to_le_bytes());
    message.extend(data);
    (topic, COMPRESSED, 0, message)
}

#[test]
fn compressed_images_are_read_where_there_are_no_others() {
    let folder = tempfile::tempdir().unwrap();
    let camera = || info("/a/camera_info", KINECT2, vec![]);
    let infrared = || compressed("/a/ir/compressed", "16UC1; png compressed ", &[]);
    let depth = |format, a: f32, b: f32| {
        let head = [[0; 4], a.to_le_bytes(), b.to_le_bytes()].concat();
        compressed("/a/depth/compressedDepth", format, &head)
    };
    let millimetres = || depth("16UC1; compressedDepth png", 0.0, 0.0);
    let inverse = depth("32FC1; compressedDepth", 1000.0, -0.5);
    let plain = image("/a/depth", Encoding::U16, KINECT2, 0, 900);
    for (entries, expected) in [
        (vec![camera(), millimetres(), infrared()], [0.0, 0.007]),
        (vec![camera(), inverse, infrared()], [0.0, 1000.0 / 7.5]),
        (vec![camera(), millimetres(), plain, infrared()], [0.9, 0.9]),
    ] {
        let path = write_bag(folder.path(), zstd(), &entries);
        let played = play(&path).unwrap();
        assert_eq!(played.damages, Vec::<String>::new());
        let depth = played.frames[0].depth.as_ref().unwrap();
        assert_eq!([*depth.at(0, 0), *depth.at(7, 0)], expected);
        assert_eq!(*played.frames[0].ir.as_ref().unwrap().at(7, 0), 7);
    }
    let entries = [camera(), depth("16UC1; compressedDepth rvl", 0.0, 0.0)];
    let path = write_bag(folder.path(), zstd(), &entries);
    let error = McapCamera::open(&path).err().unwrap().to_string();
    let found = "found /a/depth/compressedDepth (format \"16UC1; compressedDepth rvl\", must be 16UC1 or 32FC1 with compressedDepth png,";
    assert!(error.contains(found), "{error}");
}

#[test]
fn what_cannot_be_read_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let depth = |topic| image(topic, Encoding::U16, KINECT2, 0, 900);
    let camera = || info("/a/camera_info", KINECT2, vec![]);
    for (entries, expected) in [
        (
            vec![camera()],
            "no topic with depth images in 16UC1 or 32FC1; there are no image topics",
        ),
        (
            vec![camera(), image("/a/ir", Encoding::U16, KINECT2, 0, 9)],
            "no topic with depth images in 16UC1 or 32FC1; found /a/ir (16UC1, 512×424)",
        ),
        (
            vec![camera(), depth("/a/depth"), depth("/b/depth")],
            "several topics with depth images, must be one: /a/depth, /b/depth",
        ),
        (
            vec![
                info("/a/camera_info", (640, 480), vec![]),
                depth("/a/depth"),
            ],
            "no CameraInfo of 512×424 pixels for /a/depth; found /a/depth (16UC1, 512×424)",
        ),
        (
            vec![
                info("/a/camera_info", KINECT2, vec![0.1; 8]),
                depth("/a/depth"),
            ],
            "/a/camera_info: distortion model \"plumb_bob\" with coefficients [0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1], must be plumb_bob with k1 k2 p1 p2 k3",
        ),
    ] {
        let path = write_bag(folder.path(), zstd(), &entries);
        let error = McapCamera::open(&path).err().unwrap();
        assert_eq!(error.to_string(), format!("{}: {expected}", path.display()));
    }
    let path = folder.path().join("text.mcap");
    std::fs::write(&path, "this is no such file at all").unwrap();
    let error = McapCamera::open(&path).err().unwrap().to_string();
    assert!(error.ends_with("text.mcap: not an MCAP file: it begins with other bytes"));
}
