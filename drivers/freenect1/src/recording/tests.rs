use super::*;
use crate::disparity::DisparityTable;
use std::fs;

fn device() -> DeviceRecord {
    DeviceRecord {
        serial: "A7".to_owned(),
        // Constants that no decimal fraction holds.
        zero_plane: ZeroPlane {
            reference_pixel_size_mm: f64::from(0.1042_f32),
            ..ZeroPlane::TYPICAL
        },
        ir_gain: 21,
        ir_offset_px: [4.25, 3.5],
        lamp_position_m: Some([0.12, 0.0, -0.01]),
    }
}

fn image(seed: usize, (width, height): (usize, usize), range: usize) -> Image<u16> {
    let values = (0..width * height).map(|i| ((i * 7919 + seed * 104_729) >> 3) % range);
    Image::from_vec(width, height, values.map(|value| value as u16).collect())
}

fn raw(number: u64, with_disparity: bool) -> RawFrame {
    RawFrame {
        // The driver's numbers have gaps.
        frame_id: 10 + 3 * number,
        device_time_secs: depth_camera::whole_microseconds(71.0 + number as f64 / 30.0),
        host_time: Instant::now(),
        disparity: with_disparity.then(|| image(number as usize, DEPTH_SIZE, 2048)),
        // Without depth it may be of either size.
        ir: Some(match with_disparity {
            true => image(number as usize, IrSize::Medium.pixels(), 1024),
            false => image(number as usize, IrSize::High.pixels(), 1024),
        }),
    }
}

fn record(folder: &Path) {
    let mut writer = RawDisparityWriter::create(folder, &device()).unwrap();
    for number in 0..4 {
        writer.write(&raw(number, number != 2)).unwrap();
    }
    let late = writer.write(&raw(1, true)).unwrap_err();
    assert!(
        late.to_string().contains("must be finite and follow"),
        "{late}"
    );
    let mut odd = raw(9, false);
    odd.ir = Some(image(9, (640, 480), 1024));
    let odd = writer.write(&odd).unwrap_err().to_string();
    assert!(
        odd.contains("IR is 640×480, must be 640×488 or 1280×1024"),
        "{odd}"
    );
    assert_eq!(writer.finish().unwrap(), 4);
}

#[test]
fn what_was_recorded_becomes_the_frames_that_the_device_would_give() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("raw");
    record(&folder);
    let mut camera = RawDisparityCamera::open(&folder).unwrap();
    let live = device().camera_info(None);
    let replayed = camera.info().clone();
    assert_eq!(replayed.n_frames, Some(4));
    assert_eq!(
        CameraInfo {
            n_frames: None,
            ..replayed
        },
        live
    );
    assert_eq!((live.intrinsics.cx, live.intrinsics.cy), (315.25, 236.0));
    assert_eq!(live.ir_gain, Some(21));

    let decoder = FrameDecoder::new(&device().zero_plane).unwrap();
    let table = DisparityTable::new(&device().zero_plane).unwrap();
    for number in 0..4 {
        let expected = decoder.frame(raw(number, number != 2));
        let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        assert_eq!(frame.frame_id, number);
        assert_eq!(
            frame.device_time_secs.to_bits(),
            expected.device_time_secs.to_bits()
        );
        assert_eq!((&frame.depth, &frame.ir), (&expected.depth, &expected.ir));
        assert_eq!(frame.ir.unwrap().height(), 480);
        if let Some(depth) = frame.depth {
            let disparity = *raw(number, true).disparity.unwrap().at(7, 3);
            assert_eq!(*depth.at(7, 3), table.metres(disparity));
        }
    }
    assert!(camera.grab(Duration::ZERO).unwrap().is_none());
}

#[test]
fn a_spoilt_image_costs_its_moment_and_a_spoilt_device_the_recording() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("raw");
    record(&folder);
    fs::write(folder.join("disparity/000001.png"), b"no image").unwrap();
    let mut camera = RawDisparityCamera::open(&folder).unwrap();
    let grabbed: Vec<_> = (0..4).map(|_| camera.grab(Duration::ZERO)).collect();
    assert!(grabbed[0].is_ok() && grabbed[2].is_ok() && grabbed[3].is_ok());
    let Err(CameraError::DamagedFrame { frame_id, reason }) = &grabbed[1] else {
        panic!("{:?}", grabbed[1]);
    };
    assert_eq!(*frame_id, 1);
    assert!(reason.contains("disparity/000001.png"), "{reason}");

    let path = folder.join(RAW_DEVICE_FILE);
    let text = fs::read_to_string(&path).unwrap();
    for (spoilt, says) in [
        (
            text.replace(
                "reference_distance_mm = 120.0",
                "reference_distance_mm = 0.0",
            ),
            "reference_distance_mm is 0",
        ),
        (
            text.replace("ir_offset_px = [4.25", "ir_offset_px = [400.0"),
            "ir_offset_px is [400",
        ),
        (
            text.replace("[0.12, 0.0", "[nan, 0.0"),
            "lamp_position_m is NaN, must be finite",
        ),
        (
            text.replace("[0.12, 0.0", "[50.0, 0.0"),
            "must be at most 2 m",
        ),
        (text.replace("ir_gain = 21\n", ""), "ir_gain"),
    ] {
        assert_ne!(spoilt, text);
        fs::write(&path, spoilt).unwrap();
        let error = RawDisparityCamera::open(&folder).unwrap_err().to_string();
        assert!(
            error.contains("kinect1.toml") && error.contains(says),
            "{error}"
        );
    }
}
