//! What is wrong is said: which file, which key, which value, which bound, and by the exit code.

use crate::support::{EVERY_FRAME, PROGRAM, Workbench, assert_says, record, small_camera, summary};
use std::{fs, io, path::Path, process::Command};

#[test]
fn damaged_images_cost_their_own_frame_only() {
    let bench = Workbench::with_frames(5);
    let list = fs::read_to_string(bench.session().join("depth.txt")).unwrap();
    let images: Vec<_> = list
        .lines()
        .filter_map(|line| line.split_once(" depth/"))
        .map(|(_, name)| bench.session().join("depth").join(name))
        .collect();
    fs::remove_file(&images[1]).unwrap();
    let bytes = fs::read(&images[2]).unwrap();
    fs::write(&images[2], &bytes[..bytes.len() / 2]).unwrap();
    let other = bench.path("other");
    record(small_camera(1, 3), &other);
    let stranger = fs::read_dir(other.join("depth")).unwrap().next().unwrap();
    fs::copy(stranger.unwrap().path(), &images[3]).unwrap();

    let config = bench.write("every-frame.toml", EVERY_FRAME);
    let output = bench.replay(&["--config", config.to_str().unwrap()]);
    assert_says(
        &output,
        0,
        &[images[1].to_str().unwrap(), "expected 128×106"],
    );
    let frames = &summary(&output)["frames"];
    assert_eq!(
        (&frames["total"], &frames["damaged"]),
        (&5.into(), &3.into())
    );
    assert_eq!(frames["fused"], 2);
}

#[test]
fn a_description_that_makes_no_sense_is_refused() {
    for (old, new, pieces) in [
        (
            "sensor = \"kinect2\"",
            "sensor = \"kinect3\"",
            [
                "session.toml",
                "sensor is \"kinect3\", must be \"kinect1\" or",
            ],
        ),
        (
            "fx = ",
            "fx = 0.0 # ",
            ["session.toml", "ir_camera.fx is 0, must be positive"],
        ),
    ] {
        let bench = Workbench::with_frames(1);
        bench.edit("session.toml", old, new);
        let output = bench.replay(&[]);
        assert_says(&output, 1, &pieces);
        assert_eq!(summary(&output)["status"], "failed");
        assert!(!bench.path("out").exists());
    }
}

#[test]
fn what_is_no_session_is_said_to_be_none() {
    let bench = Workbench::with_frames(1);
    let empty = bench.path("empty");
    fs::create_dir(&empty).unwrap();
    let is_neither = "is neither a session's folder (no session.toml, no .mcap) nor an .mcap file";
    let run = |command: &str, path: &std::path::Path| {
        let mut relief = Command::new(PROGRAM);
        let out = bench.path("out");
        relief.arg(command).arg(path).arg("--out").arg(out);
        relief.output().unwrap()
    };
    let description = bench.session().join("session.toml");
    for path in [&empty, &description] {
        let message = format!("{} {is_neither}", path.display());
        assert_says(&run("replay", path), 1, &[&message]);
    }
    assert_says(
        &run("refine", &description),
        1,
        &["session.toml is no output folder of a scan"],
    );
}

#[test]
fn images_that_are_too_large_to_work_on_are_refused() {
    let bench = Workbench::with_frames(1);
    bench.edit("session.toml", "width = ", "width = 4096 # ");
    bench.edit("session.toml", "height = ", "height = 2048 # ");
    let output = bench.replay(&[]);
    let pieces = ["session: width × height is 4096 × 2048", "below 8388608"];
    assert_says(&output, 1, &pieces);
    assert!(!bench.path("out").exists());
}

#[test]
fn times_must_increase() {
    for second in ["99.000000", "100.000000"] {
        let bench = Workbench::with_frames(2);
        bench.edit("depth.txt", "100.033333", second);
        let message = format!(
            "timestamp {} follows 100, must be later",
            second.trim_end_matches('0').trim_end_matches('.')
        );
        assert_says(&bench.replay(&[]), 1, &["depth.txt: line 3", &message]);
    }
}

#[test]
fn poses_must_be_numbers_and_frames_without_one_are_lost() {
    let bench = Workbench::with_frames(2);
    let bad = bench.write("bad.txt", "100.0 0 0 0 0 0 0 1\n100.03 nan 0 0 0 0 0 1\n");
    let output = bench.replay(&["--poses", bad.to_str().unwrap()]);
    assert_says(&output, 1, &["bad.txt: line 2", "tx"]);

    let one = bench.write("one.txt", "100.01 0 0 0 0 0 0 1\n");
    let config = bench.write("every-frame.toml", EVERY_FRAME);
    let config = ["--config", config.to_str().unwrap()];
    let output = bench.replay(&[&config[..], &["--poses", one.to_str().unwrap()]].concat());
    assert_says(&output, 0, &["no given pose within 20 ms"]);
    let frames = &summary(&output)["frames"];
    assert_eq!((&frames["fused"], &frames["lost"]), (&1.into(), &1.into()));
}

#[test]
fn poses_beyond_the_volume_are_refused_where_a_frame_uses_them() {
    let bench = Workbench::with_frames(2);
    let far = bench.write(
        "far.txt",
        "100.0 0 0 0 0 0 0 1\n100.033333 0 -10.5 0 0 0 0 1\n",
    );
    let output = bench.replay(&["--poses", far.to_str().unwrap()]);
    let pieces = [
        "far.txt: the pose at 100.033333 s lies at 0.000 -10.500 0.000 m",
        "within 10.192 m of 0",
        "shift the poses",
    ];
    assert_says(&output, 1, &pieces);
    assert!(!bench.path("out").exists());
    // Larger voxels reach farther, and at a minute before the first frame the camera may have been anywhere.
    let early = bench.write(
        "early.txt",
        "40.0 20 0 0 0 0 0 1\n100.0 0 0 0 0 0 0 1\n100.033333 0 0 0 0 0 0 1\n",
    );
    let config = bench.write("every-frame.toml", EVERY_FRAME);
    let config = ["--config", config.to_str().unwrap()];
    for more in [
        &["--poses", far.to_str().unwrap(), "--voxel-size", "0.003"][..],
        &["--poses", early.to_str().unwrap()],
    ] {
        let output = bench.replay(&[&config[..], more].concat());
        assert_says(&output, 0, &[]);
        assert_eq!(summary(&output)["frames"]["fused"], 2);
        fs::remove_dir_all(bench.path("out")).unwrap();
    }
}

#[test]
fn a_model_without_surface_is_no_success_and_not_for_want_of_an_object() {
    let bench = Workbench::with_frames(1);
    let reason =
        "the model has no surface: no place was seen often enough (fusion.min_surface_weight)";
    let config = bench.write("crop.toml", "[object]\ncrop = \"object\"\n");
    let config = ["--config", config.to_str().unwrap()];
    // Nor is it for want of what lies in a box.
    for more in [&[][..], &["--roi", "-1,-1,0,1,1,2"]] {
        let output = bench.replay(&[&config[..], more].concat());
        assert_says(&output, 1, &[reason]);
        let told = summary(&output);
        assert_eq!(told["status"], "failed");
        assert!(told["failures"][0].as_str().unwrap().starts_with(reason));
        assert_eq!(told["base_mesh"]["faces"], 0);
        let warnings = told["warnings"].to_string();
        let missing = "base.ply is of the whole scene: the model has no surface";
        assert!(warnings.contains(missing), "{warnings}");
        fs::remove_dir_all(bench.path("out")).unwrap();
    }
}

#[test]
fn a_session_without_depth_in_range_fails_with_its_counts() {
    let bench = Workbench::with_frames(3);
    let config = bench.write(
        "near.toml",
        "[fusion]\ndepth_min_m = 0.1\ndepth_max_m = 0.16\n",
    );
    let output = bench.replay(&["--config", config.to_str().unwrap()]);
    assert_says(
        &output,
        1,
        &["could be fused: 3 frames, of which 0 damaged, 3 without depth"],
    );
    let told = summary(&output);
    assert_eq!(told["status"], "failed");
    assert_eq!(told["not_refined_reason"], "there is no scan to refine");
}

#[test]
fn an_output_folder_must_be_new_and_belong_to_one_run() {
    let bench = Workbench::with_frames(1);
    let out = bench.path("out");
    fs::create_dir(&out).unwrap();
    fs::write(out.join("thesis.tex"), "").unwrap();
    assert_says(&bench.replay(&[]), 1, &["is not empty; name a new one"]);
    fs::remove_file(out.join("thesis.tex")).unwrap();
    fs::write(out.join(".relief.lock"), "").unwrap();
    assert_says(&bench.replay(&[]), 1, &["is in use by another run"]);
}

#[test]
fn an_output_folder_that_cannot_be_made_is_named() {
    let bench = Workbench::with_frames(1);
    bench.write("out", "a file");
    assert_says(
        &bench.replay(&[]),
        1,
        &["cannot use output folder", "/out: "],
    );
}

/// A limit on the size of files stands in for a full disk: both fail in the middle of a file.
#[test]
fn a_file_that_does_not_fit_is_named_and_leaves_nothing_behind() {
    let bench = Workbench::with_frames(4);
    let script = format!(
        "trap '' XFSZ; ulimit -f 64; exec {PROGRAM} replay {} --out {} --no-refine",
        bench.session().display(),
        bench.path("out").display()
    );
    let output = Command::new("sh").args(["-c", &script]).output().unwrap();
    assert_says(&output, 1, &["base.ply: ", "os error 27", "report"]);
    let out = bench.path("out");
    for name in [
        "base.ply",
        ".base.ply.partial",
        ".relief.lock",
        "report.html",
    ] {
        assert!(!out.join(name).exists(), "{name}");
    }
    assert!(out.join("trajectory.txt").is_file());
    // What is named as an output is there, and only that is named.
    let told = String::from_utf8_lossy(&output.stdout);
    for line in ["base mesh:", "report:"] {
        assert!(!told.contains(line), "{told}");
    }
    let report = fs::read_to_string(out.join("report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let outputs = report["outputs"].as_array().unwrap();
    assert!(outputs.len() > 2);
    for path in outputs {
        assert!(Path::new(path.as_str().unwrap()).exists(), "{path}");
    }
}

#[test]
fn a_lock_that_does_not_fit_leaves_neither_itself_nor_the_folder() {
    let bench = Workbench::with_frames(1);
    let out = bench.path("out");
    let replay = || {
        let script = format!(
            "trap '' XFSZ; ulimit -f 0; exec {PROGRAM} replay {} --out {} --no-refine",
            bench.session().display(),
            out.display()
        );
        Command::new("sh").args(["-c", &script]).output().unwrap()
    };
    assert_says(&replay(), 1, &["cannot use output folder", "os error 27"]);
    assert!(!out.exists());
    // One that was there stays.
    fs::create_dir(&out).unwrap();
    assert_says(&replay(), 1, &["cannot use output folder"]);
    assert_eq!(fs::read_dir(&out).unwrap().count(), 0);
}

#[test]
fn configuration_and_calibration_are_checked_before_anything_is_made() {
    let bench = Workbench::with_frames(1);
    let calibration = include_str!("../../config/calibration-kinect2.toml");
    for (flag, text, pieces) in [
        (
            "--config",
            "[fusion]\nvoxel_size_m = -1.0\n".to_owned(),
            [
                "bad.toml:2: ",
                "fusion.voxel_size_m is -1, must be 0.0005 to",
            ],
        ),
        (
            "--config",
            "[refine]\nn_roundz = 1\n".to_owned(),
            ["bad.toml:2: refine.n_roundz: ", "unknown field `n_roundz`"],
        ),
        (
            "--calibration",
            calibration.replace("gamma = 0.87", "gamma = 9.0"),
            ["bad.toml: ", "gamma is 9, must be 0.2 to 3"],
        ),
    ] {
        let file = bench.write("bad.toml", &text);
        let output = bench.replay(&[flag, file.to_str().unwrap()]);
        assert_says(&output, 2, &pieces);
        assert!(!bench.path("out").exists());
    }
}

#[test]
fn flags_are_checked() {
    let bench = Workbench::with_frames(1);
    for (flag, value, piece) in [
        ("--roi", "0,0,0,1,1", "5 numbers, must be 6"),
        ("--roi", "0,0,2,1,1,1", "zmin is 2, must be below zmax, 1"),
        ("--voxel-size", "0", "fusion.voxel_size_m is 0, must be"),
        ("--max-snapshots", "0", "max_snapshots is 0, must be"),
        ("--threads", "0", "--threads"),
    ] {
        assert_says(&bench.replay(&[flag, value]), 2, &[piece]);
    }
    let missing = bench.path("nowhere");
    let output = bench.replay(&["--calibration-dir", missing.to_str().unwrap()]);
    assert_says(&output, 2, &["--calibration-dir: ", "nowhere is no folder"]);
    assert!(!bench.path("out").exists());
    let missing = bench.path("nowhere.toml");
    let output = bench.replay(&["--config", missing.to_str().unwrap()]);
    assert_says(&output, 2, &["nowhere.toml: No such file"]);
}

#[test]
fn what_cannot_be_printed_is_told_but_not_that_nobody_reads_it() {
    let shell = |script: &str| Command::new("sh").args(["-c", script]).output().unwrap();
    let full = shell(&format!("exec {PROGRAM} config show >/dev/full"));
    assert_says(&full, 1, &["error: cannot print: No space left on device"]);
    let (reader, writer) = io::pipe().unwrap();
    drop(reader);
    let mut unread = Command::new(PROGRAM);
    let unread = unread.args(["config", "show"]).stdout(writer).output();
    let unread = unread.unwrap();
    assert_eq!(unread.status.code(), Some(0));
    assert_eq!(String::from_utf8_lossy(&unread.stderr), "");
}

#[test]
fn what_cannot_be_said_on_standard_error_ends_no_run() {
    let bench = Workbench::with_frames(2);
    let config = bench.write("every-frame.toml", EVERY_FRAME);
    let script = format!(
        "exec {PROGRAM} replay {} --out {} --config {} --no-refine 2>/dev/full",
        bench.session().display(),
        bench.path("out").display(),
        config.display()
    );
    let output = Command::new("sh").args(["-c", &script]).output().unwrap();
    assert_eq!(output.status.code(), Some(0));
    let failed = format!("exec {PROGRAM} replay nowhere --out out 2>/dev/full");
    let output = Command::new("sh").args(["-c", &failed]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
}
