//! Sessions written, read, broken and refused.

mod support;

use std::{
    fs,
    path::Path,
    time::{Duration, Instant},
};

use depth_camera::{CameraError, DepthCamera, Frame, Image};
use replay::{
    Pacing, RepeatingCamera, ReplayCamera, SESSION_FILE_NAME, SessionWriter, WriteError,
    content_hash, read_poses, unknown_keys,
};
use support::{play, tiny_camera, tiny_frame, write_tiny_session};

#[test]
fn what_was_written_is_read_again() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path().join("session");
    write_tiny_session(&folder);
    let mut camera = ReplayCamera::open(&folder).unwrap();

    let mut expected = tiny_camera();
    expected.n_frames = Some(3);
    assert_eq!(camera.info(), &expected);
    let frames = play(&mut camera);
    assert_eq!(frames.len(), 3);
    for (frame_id, frame) in (0..).zip(frames) {
        let (frame, written) = (frame.unwrap(), tiny_frame(frame_id));
        assert_eq!(frame.frame_id, frame_id);
        assert!((frame.device_time_secs - written.device_time_secs).abs() < 1e-6);
        assert_eq!(frame.ir, written.ir);
        let (depth, expected) = (frame.depth.unwrap(), written.depth.unwrap());
        for (found, metres) in depth.data().iter().zip(expected.data()) {
            // Half a unit of 1 mm, and the rounding of f32.
            assert!((found - metres).abs() < 0.5001e-3);
        }
        assert_eq!(depth.data()[3], 0.0);
    }
}

#[test]
fn keys_that_nobody_reads_are_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let mut camera = tiny_camera();
    camera.driver = Some("libfreenect2".to_owned());
    camera.ir_gain = Some(7);
    drop(SessionWriter::create(folder.path(), &camera, 1000.0).unwrap());
    assert_eq!(unknown_keys(folder.path()), Vec::<String>::new());

    let path = folder.path().join(SESSION_FILE_NAME);
    let text = fs::read_to_string(&path).unwrap();
    let text = text.replace("[light]", "[light]\ncolour = 850");
    fs::write(
        &path,
        format!("seriall = \"7\"\n{text}\n[object]\nmin = 0\n"),
    )
    .unwrap();
    let [seriall, colour] = &unknown_keys(folder.path())[..] else {
        panic!("two keys that nobody reads");
    };
    assert_says(seriall, &["session.toml: line 1: ", " seriall"]);
    assert_says(colour, &[" light.colour"]);
}

#[test]
fn the_hash_is_that_of_the_contents_alone() {
    let root = tempfile::tempdir().unwrap();
    let [one, two] = ["a/session", "b/session"].map(|name| root.path().join(name));
    write_tiny_session(&one);
    write_tiny_session(&two);
    fs::write(two.join("note.txt"), "by lamplight").unwrap();
    let hash = content_hash(&one).unwrap();
    assert_eq!(hash.len(), "sha256:".len() + 64);
    assert_eq!(content_hash(&two), Ok(hash.clone()));

    let list = fs::read_to_string(two.join("depth.txt")).unwrap();
    let first = list.lines().find_map(|line| line.split_once(" depth/"));
    let image = two.join("depth").join(first.unwrap().1);
    fs::write(image, "another image").unwrap();
    assert_ne!(content_hash(&two), Ok(hash));
    assert!(content_hash(root.path()).is_err());
}

#[test]
fn depth_beyond_sixteen_bits_is_no_measurement() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = SessionWriter::create(folder.path(), &tiny_camera(), 1000.0).unwrap();
    let mut frame = tiny_frame(0);
    let depth = frame.depth.as_mut().unwrap().data_mut();
    depth[..5].copy_from_slice(&[65.535, 65.536, -1.0, f32::NAN, f32::INFINITY]);
    writer.write(&frame).unwrap();
    let mut camera = ReplayCamera::open(folder.path()).unwrap();
    let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
    assert_eq!(
        frame.depth.unwrap().data()[..5],
        [65.535, 0.0, 0.0, 0.0, 0.0]
    );
}

#[test]
fn a_recording_that_was_cut_short_plays() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = SessionWriter::create(folder.path(), &tiny_camera(), 1000.0).unwrap();
    writer.write(&tiny_frame(0)).unwrap();
    // Killed here: an image half written under its temporary name, and in no list.
    fs::write(folder.path().join("depth/00001.partial"), "half a PNG").unwrap();
    std::mem::forget(writer);
    let mut camera = ReplayCamera::open(folder.path()).unwrap();
    assert_eq!(play(&mut camera).len(), 1);
}

#[test]
fn the_writer_refuses_what_would_not_be_read_again() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = SessionWriter::create(folder.path(), &tiny_camera(), 1000.0).unwrap();
    writer.write(&tiny_frame(5)).unwrap();
    let empty = Frame {
        depth: None,
        ir: None,
        ..tiny_frame(6)
    };
    let small = Frame {
        ir: Some(Image::filled(7, 4, 0)),
        ..tiny_frame(6)
    };
    let timeless = Frame {
        device_time_secs: f64::NAN,
        ..tiny_frame(6)
    };
    for (frame, words) in [
        (tiny_frame(5), vec!["100.166667", "must be later"]),
        (empty, vec!["no image"]),
        (small, vec!["IR", "7×4", "7×5"]),
        (timeless, vec!["NaN", "finite"]),
    ] {
        let error = writer.write(&frame).unwrap_err().to_string();
        assert_says(&error, &words);
    }
    writer.write(&tiny_frame(6)).unwrap();
    assert_eq!(writer.finish().unwrap(), 2);
    assert_eq!(
        play(&mut ReplayCamera::open(folder.path()).unwrap()).len(),
        2
    );

    let again = SessionWriter::create(folder.path(), &tiny_camera(), 1000.0);
    assert!(matches!(again, Err(WriteError::NotEmpty(path)) if path == folder.path()));
    let no_scale = SessionWriter::create(&folder.path().join("new"), &tiny_camera(), 0.0);
    assert_says(
        &no_scale.unwrap_err().to_string(),
        &["session.toml", "depth_units_per_metre is 0", "positive"],
    );
    assert!(!folder.path().join("new").exists());
}

#[test]
fn a_folder_that_cannot_be_written_is_named_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, "").unwrap();
    let error = SessionWriter::create(&file.join("session"), &tiny_camera(), 1000.0);
    assert_says(
        &error.unwrap_err().to_string(),
        &["file/session", "os error"],
    );

    let mut writer =
        SessionWriter::create(&folder.path().join("s"), &tiny_camera(), 1000.0).unwrap();
    fs::remove_dir(folder.path().join("s/depth")).unwrap();
    let error = writer.write(&tiny_frame(0)).unwrap_err().to_string();
    assert_says(&error, &["s/depth/00000.png", "os error"]);
    fs::create_dir(folder.path().join("s/depth")).unwrap();
    writer.write(&tiny_frame(0)).unwrap();
}

#[test]
fn a_damaged_image_costs_its_own_frame() {
    type Damage = fn(&Path);
    let eight_bit: Damage = |path| {
        let file = fs::File::create(path).unwrap();
        let encoder = png::Encoder::new(file, 7, 5);
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(&[0; 35]).unwrap();
    };
    let small: Damage = |path| {
        let mut encoder = png::Encoder::new(fs::File::create(path).unwrap(), 6, 5);
        encoder.set_depth(png::BitDepth::Sixteen);
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(&[0; 60]).unwrap();
    };
    let truncate: Damage = |path| {
        let bytes = fs::read(path).unwrap();
        fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
    };
    let endless: Damage = |path| {
        fs::remove_file(path).unwrap();
        std::os::unix::fs::symlink("/dev/zero", path).unwrap();
    };
    let huge: Damage = |path| {
        let file = fs::File::create(path).unwrap();
        file.set_len(1 << 30).unwrap();
    };
    let damages: [(Damage, &[&str]); 7] = [
        (|path| fs::remove_file(path).unwrap(), &["os error"]),
        (|path| fs::write(path, "no image").unwrap(), &["not a PNG"]),
        (truncate, &["PNG"]),
        (eight_bit, &["8-bit", "expected 16-bit"]),
        (small, &["6×5", "expected 7×5"]),
        (endless, &["no ordinary file"]),
        (huge, &["1073741824 bytes, must be at most 67108864"]),
    ];
    for (damage, words) in damages {
        for image in ["depth/00001.png", "ir/00001.png"] {
            let folder = tempfile::tempdir().unwrap();
            write_tiny_session(folder.path());
            damage(&folder.path().join(image));
            let mut frames = play(&mut ReplayCamera::open(folder.path()).unwrap());
            assert_eq!(frames.len(), 3);
            let Err(CameraError::DamagedFrame { frame_id, reason }) = frames.remove(1) else {
                panic!("{image} must be refused: {words:?}");
            };
            assert_eq!(frame_id, 1);
            assert_says(&reason, words);
            assert_says(&reason, &[image]);
            assert_eq!(frames.pop().unwrap().unwrap().frame_id, 2);
        }
    }
}

#[test]
fn recorded_pace_times_out_until_a_frame_is_due() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = SessionWriter::create(folder.path(), &tiny_camera(), 1000.0).unwrap();
    // The last one comes so late that no machine is busy until then.
    for (frame_id, offset_secs) in [(0, 0.0), (1, 0.05), (2, 3600.0)] {
        let mut frame = tiny_frame(frame_id);
        frame.device_time_secs = 100.0 + offset_secs;
        writer.write(&frame).unwrap();
    }
    writer.finish().unwrap();
    let camera = ReplayCamera::open(folder.path()).unwrap();
    let mut camera = camera.with_pacing(Pacing::Recorded);
    let start = Instant::now();
    assert_eq!(camera.grab(Duration::ZERO).unwrap().unwrap().frame_id, 0);
    let patience = Duration::from_secs(1);
    assert_eq!(camera.grab(patience).unwrap().unwrap().frame_id, 1);
    assert!(start.elapsed() >= Duration::from_millis(49));
    // It is not passed over either: the recording does not end.
    for _ in 0..2 {
        let early = camera.grab(Duration::from_millis(1)).unwrap_err();
        assert_eq!(early, CameraError::NotDue);
        assert!(early.is_recoverable());
    }
}

#[test]
fn a_repeated_session_goes_on_evenly() {
    let folder = tempfile::tempdir().unwrap();
    write_tiny_session(folder.path());
    let path = folder.path().to_owned();
    let open = move || Ok(Box::new(ReplayCamera::open(&path)?) as Box<dyn DepthCamera>);
    let mut camera = RepeatingCamera::new(Box::new(open)).unwrap();
    assert_eq!(camera.info().n_frames, None);
    for frame_id in 0..8 {
        let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        assert_eq!(frame.frame_id, frame_id);
        let expected = tiny_frame(frame_id);
        // Times are stored in microseconds.
        assert!((frame.device_time_secs - expected.device_time_secs).abs() < 1e-5);
        assert_eq!(frame.ir, tiny_frame(frame_id % 3).ir);
    }
}

#[test]
fn every_fault_of_a_description_or_a_list_is_named() {
    // File, what stands there, what it is broken to, what the message must say.
    let faults: [(&str, &str, &str, &[&str]); 31] = [
        ("session.toml", "name = ", "nome = ", &["name"]),
        (
            "session.toml",
            "\"kinect2\"",
            "\"kinect3\"",
            &["sensor", "kinect3", "kinect1"],
        ),
        (
            "session.toml",
            "metre = 1000.0",
            "metre = -5",
            &["depth_units_per_metre is -5", "positive"],
        ),
        (
            "session.toml",
            "metre = 1000.0",
            "metre = inf",
            &["depth_units_per_metre is inf", "finite"],
        ),
        (
            "session.toml",
            "65535.0",
            "0.0",
            &["ir_full_scale is 0", "positive"],
        ),
        (
            "session.toml",
            "65535.0",
            "nan",
            &["ir_full_scale is NaN", "finite"],
        ),
        (
            "session.toml",
            "65535.0",
            "65536",
            &["ir_full_scale is 65536", "at most 65535"],
        ),
        (
            "session.toml",
            "ir_full_scale",
            "ir_scale",
            &["ir_full_scale is missing", "ir.txt"],
        ),
        (
            "session.toml",
            "[light]",
            "[lamp]",
            &["[light] is missing", "ir.txt"],
        ),
        (
            "session.toml",
            "width = 7",
            "width = 0",
            &["ir_camera.width is 0", "from 1"],
        ),
        (
            "session.toml",
            "height = 5",
            "height = -5",
            &["height = -5"],
        ),
        (
            "session.toml",
            "height = 5",
            "height = 99999",
            &["ir_camera.height is 99999", "16384"],
        ),
        (
            "session.toml",
            "fx = 5.25",
            "fx = 0.0",
            &["ir_camera.fx is 0", "positive"],
        ),
        (
            "session.toml",
            "fy = 5.5",
            "fy = nan",
            &["ir_camera.fy is NaN", "finite"],
        ),
        (
            "session.toml",
            "fy = 5.5",
            "fy = \"long\"",
            &["fy = \"long\"", "f64"],
        ),
        (
            "session.toml",
            "cx = 3.1",
            "cx = 6.5",
            &["ir_camera.cx is 6.5", "0 to 6"],
        ),
        (
            "session.toml",
            "cy = 2.2",
            "cy = -1",
            &["ir_camera.cy is -1", "0 to 4"],
        ),
        (
            "session.toml",
            "k1 = 0.0905",
            "k1 = inf",
            &["ir_camera.k1 is inf", "finite"],
        ),
        ("session.toml", "k3 = 0.0949", "", &["k3"]),
        (
            "session.toml",
            "[0.052,",
            "[2.5,",
            &["light.position is 2.5", "at most 2 m"],
        ),
        (
            "session.toml",
            "[0.052,",
            "[nan,",
            &["light.position is NaN", "finite"],
        ),
        (
            "session.toml",
            "\"emitter\"",
            "\"sun\"",
            &["light.kind", "sun", "lamp"],
        ),
        (
            "depth.txt",
            "100.033333",
            "nan",
            &["line 3", "\"nan\"", "finite"],
        ),
        ("depth.txt", "100.033333", "soon", &["line 3", "\"soon\""]),
        (
            "depth.txt",
            "100.033333",
            "99.5",
            &["line 3", "99.5 follows 100", "later"],
        ),
        (
            "ir.txt",
            "100.033333",
            "100.0",
            &["line 3", "100 follows 100", "later"],
        ),
        ("ir.txt", " ir/00001.png", "", &["line 3", "file name"]),
        (
            "depth.txt",
            "depth/00001.png",
            "../00001.png",
            &["line 3", "../00001.png", "folder"],
        ),
        (
            "depth.txt",
            "depth/00001.png",
            "/tmp/1.png",
            &["line 3", "/tmp/1.png", "relative"],
        ),
        ("poses.txt", "", "", &["no pose"]),
        ("depth.txt", "", "", &["holds no frame"]),
    ];
    for (file, old, new, words) in faults {
        let folder = tempfile::tempdir().unwrap();
        write_tiny_session(folder.path());
        let path = folder.path().join(file);
        let error = if file == "poses.txt" {
            fs::write(&path, new).unwrap();
            read_poses(&path).map(|_| ()).unwrap_err()
        } else {
            let text = fs::read_to_string(&path).unwrap();
            let broken = match old {
                "" => new.to_owned(),
                _ => text.replacen(old, new, 1),
            };
            assert_ne!(text, broken, "{old} is not in {file}");
            fs::write(&path, broken).unwrap();
            ReplayCamera::open(folder.path()).map(|_| ()).unwrap_err()
        };
        assert!(matches!(error, CameraError::Invalid(_)));
        assert_says(&error.to_string(), words);
        assert_says(&error.to_string(), &[path.to_str().unwrap()]);
    }
}

#[test]
fn a_missing_file_is_named() {
    for file in ["session.toml", "depth.txt"] {
        let folder = tempfile::tempdir().unwrap();
        write_tiny_session(folder.path());
        fs::remove_file(folder.path().join(file)).unwrap();
        let error = ReplayCamera::open(folder.path()).map(|_| ()).unwrap_err();
        assert_says(&error.to_string(), &[file, "os error"]);
    }
}

#[test]
fn a_session_without_ir_needs_no_light() {
    let folder = tempfile::tempdir().unwrap();
    write_tiny_session(folder.path());
    fs::remove_file(folder.path().join("ir.txt")).unwrap();
    let mut camera = ReplayCamera::open(folder.path()).unwrap();
    assert!(camera.info().light.is_none() && camera.info().ir_full_scale.is_none());
    assert!(
        play(&mut camera)
            .iter()
            .flatten()
            .all(|frame| frame.ir.is_none())
    );
}

#[test]
fn poses_are_read_normalised_and_their_faults_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("poses.txt");
    fs::write(
        &path,
        "# t\n1.5 1 2 3 0 0 0 1.001\n2 -1 -2 -3 0.5 -0.5 0.5 0.5\n",
    )
    .unwrap();
    let poses = read_poses(&path).unwrap();
    assert_eq!(poses[0].time_secs, 1.5);
    assert_eq!(poses[0].translation_m, [1.0, 2.0, 3.0]);
    assert_eq!(poses[0].rotation_xyzw, [0.0, 0.0, 0.0, 1.0]);
    assert_eq!(poses[1].rotation_xyzw, [0.5, -0.5, 0.5, 0.5]);

    for (line, words) in [
        ("2 0 0 0 0 0 0 1.02", vec!["norm is 1.02", "0.01 of 1"]),
        ("2 0 0 0 0 0 0", vec!["7 values", "must be 8"]),
        ("2 0 x 0 0 0 0 1", vec!["ty is \"x\"", "finite"]),
        ("2 0 0 0 0 0 nan 1", vec!["qz is \"nan\"", "finite"]),
        ("1 0 0 0 0 0 0 1", vec!["1 follows 1", "later"]),
    ] {
        fs::write(&path, format!("1 0 0 0 0 0 0 1\n{line}\n")).unwrap();
        let error = read_poses(&path).unwrap_err().to_string();
        assert_says(&error, &words);
        assert_says(&error, &["poses.txt", "line 2"]);
    }
}

fn assert_says(message: &str, words: &[&str]) {
    for word in words {
        assert!(message.contains(word), "\"{message}\" lacks \"{word}\"");
    }
}
