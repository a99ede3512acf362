//! `relief session`, and recordings in place of folders of images.

use crate::support::{
    EVERY_FRAME, PROGRAM, Workbench, assert_says, demo, fuse, fused_demo, summary,
};
use serde_json::Value;
use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

fn session(arguments: &[&str]) -> Output {
    Command::new(PROGRAM)
        .arg("session")
        .args(arguments)
        .output()
        .unwrap()
}

/// What a command says in JSON; it must have ended well.
fn said(arguments: &[&str]) -> Value {
    let output = session(&[arguments, &["--json"]].concat());
    assert_says(&output, 0, &[]);
    summary(&output)
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The base mesh of a session, fused only.
fn base_mesh(session: &Path, out: &Path) -> Vec<u8> {
    fuse(session, out, &[]);
    fs::read(out.join("base.ply")).unwrap()
}

#[test]
fn a_session_without_a_whole_frame_leaves_nothing() {
    let bench = Workbench::with_frames(1);
    fs::remove_dir_all(bench.session().join("depth")).unwrap();
    let out = bench.path("again");
    for command in ["import", "export"] {
        let output = session(&[command, text(&bench.session()), "--out", text(&out)]);
        assert_says(&output, 1, &["no frame is whole"]);
        assert!(!out.exists());
    }
}

#[test]
fn what_is_damaged_is_left_out_and_told_of() {
    let bench = Workbench::with_frames(3);
    bench.edit("session.toml", "[light]", "[light]\ncolour = 850");
    let config = bench.write("every-frame.toml", EVERY_FRAME);
    fs::remove_file(bench.session().join("depth/00001.png")).unwrap();
    for command in ["import", "export"] {
        let out = bench.path(command);
        let output = session(&[
            command,
            text(&bench.session()),
            "--out",
            text(&out),
            "--json",
        ]);
        let said = ["1 of 3 frames are damaged", "light.colour"];
        assert_says(&output, 1, &said);
        let converted = summary(&output);
        assert_eq!(
            (&converted["frames"], &converted["damaged"]),
            (&2.into(), &1.into())
        );
        // What there is can be played.
        let fused = bench.path(&format!("{command}ed"));
        fuse(&out, &fused, &["--config", text(&config)]);
    }
}

#[test]
fn the_demo_as_a_recording_gives_the_same_mesh_to_the_byte() {
    let root = tempfile::tempdir().unwrap();
    let recording = root.path().join("recording");
    let imported = said(&["import", text(&demo()), "--out", text(&recording)]);
    assert_eq!(
        (&imported["frames"], &imported["damaged"]),
        (&48.into(), &0.into())
    );
    let images = root.path().join("a");
    fused_demo(&images);
    let of_images = fs::read(images.join("base.ply")).unwrap();
    let of_recording = base_mesh(&recording, &root.path().join("b"));
    assert!(of_images == of_recording, "the meshes differ");
    // One file of it, without the folder around it but with its calibration.
    let alone = root.path().join("alone");
    fs::create_dir(&alone).unwrap();
    let file = alone.join("scan.mcap");
    fs::copy(recording.join("segment-0000.mcap"), &file).unwrap();
    fs::copy(
        recording.join("calibration.toml"),
        alone.join("calibration.toml"),
    )
    .unwrap();
    let of_file = base_mesh(&file, &root.path().join("c"));
    assert!(of_images == of_file, "the meshes differ");
}

#[test]
fn images_in_the_place_of_a_recording_are_told_how_to_become_one() {
    let bench = Workbench::with_frames(1);
    for command in ["info", "verify", "repair"] {
        let output = session(&[command, text(&bench.session())]);
        assert_says(&output, 1, &["relief session import"]);
    }
}

#[test]
fn images_become_a_recording_and_images_again() {
    let bench = Workbench::with_frames(4);
    let (recording, again) = (bench.path("recording"), bench.path("again"));
    said(&["import", text(&bench.session()), "--out", text(&recording)]);
    let listed = said(&["ls", text(&bench.path(""))]);
    let listed = listed["recordings"].as_array().unwrap();
    assert_eq!(listed.len(), 1);
    assert_eq!(listed[0]["path"], text(&recording));
    assert_eq!(listed[0]["state"], "closed");
    let info = said(&["info", text(&recording)]);
    assert_eq!(info["session"]["counters"]["frames"], 4);
    assert_eq!(info["camera"]["width"], 128);
    assert_eq!(info["depth_units_per_metre"], 5000.0);

    let exported = said(&["export", text(&recording), "--out", text(&again)]);
    assert_eq!(exported["frames"], 4);
    for list in ["depth.txt", "ir.txt"] {
        let lists = [bench.session(), again.clone()].map(|folder| folder.join(list));
        let texts = lists.map(|path| fs::read_to_string(path).unwrap());
        assert_eq!(texts[0], texts[1]);
    }
    for image in ["depth/00003.png", "ir/00000.png"] {
        let images = [bench.session(), again.clone()].map(|folder| folder.join(image));
        let bytes = images.map(|path| fs::read(path).unwrap());
        assert!(bytes[0] == bytes[1], "{image} differs");
    }

    let output = session(&["import", text(&again), "--out", text(&recording)]);
    assert_says(&output, 1, &["is not empty"]);
    assert_eq!(
        said(&["rm", text(&recording)])["removed"][0],
        text(&recording)
    );
    assert!(!recording.exists());
    let output = session(&["rm", text(&again)]);
    assert_says(&output, 1, &["session.json"]);
    assert!(again.join("depth.txt").exists(), "images are no recording");
}

#[test]
fn damage_is_found_and_mended() {
    let bench = Workbench::with_frames(4);
    let recording = bench.path("recording");
    said(&["import", text(&bench.session()), "--out", text(&recording)]);
    assert_eq!(said(&["verify", text(&recording)])["whole"], true);
    let said_whole = said(&["repair", text(&recording)]);
    assert_eq!(said_whole["recordings"][0]["repaired"], false);

    let segment = recording.join("segment-0000.mcap");
    let mut bytes = fs::read(&segment).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    bytes.truncate(bytes.len() - 10);
    fs::write(&segment, bytes).unwrap();
    let output = session(&["verify", text(&recording), "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let verified = summary(&output);
    assert_eq!(verified["whole"], false);
    let problems = verified["files"][0]["problems"].to_string();
    assert!(problems.contains("a chunk: "), "{problems}");
    assert!(problems.contains("the file ends"), "{problems}");

    // Left open, as by a process that died: found from the folder above.
    let record = recording.join("session.json");
    let description = fs::read_to_string(&record).unwrap();
    fs::write(&record, description.replace("\"closed\"", "\"open\"")).unwrap();
    fs::write(recording.join("open.lock"), "00000000000000000004").unwrap();
    let repaired = said(&["repair", text(&bench.path(""))])["recordings"][0].clone();
    assert_eq!(repaired["repaired"], true);
    let recovered = repaired["repair"]["frames_recovered"].as_u64().unwrap();
    let lost = repaired["repair"]["frames_lost"].as_u64().unwrap();
    assert_eq!(recovered + lost, 4);
    assert_eq!(said(&["verify", text(&recording)])["whole"], true);
}

#[test]
fn repair_says_where_there_is_nothing_that_it_could_mend() {
    let bench = Workbench::with_frames(1);
    let folder = bench.path("");
    let output = session(&["repair", text(&folder)]);
    assert_says(&output, 0, &[]);
    let printed = String::from_utf8_lossy(&output.stdout);
    let nothing = format!("no recordings were left open in {}\n", folder.display());
    assert_eq!(printed, nothing);
    assert_eq!(
        said(&["repair", text(&folder)])["recordings"],
        Value::Array(Vec::new())
    );

    let recording = bench.path("recording");
    said(&["import", text(&bench.session()), "--out", text(&recording)]);
    fs::remove_file(recording.join("session.json")).unwrap();
    let output = session(&["repair", text(&recording)]);
    assert_says(&output, 1, &["holds .mcap files but no session.json"]);
    for name in ["recording/segment-0000.mcap", "nowhere"] {
        let output = session(&["repair", text(&bench.path(name))]);
        assert_says(&output, 1, &[name, "is no folder"]);
    }
}
