//! What of a scan is delivered: the object alone, closed, and with its poses put right.

use crate::support::{
    EVERY_FRAME, PROGRAM, Workbench, assert_says, demo, fuse, fused_demo, record, small_camera,
    summary,
};
use relief::{export::read_ply, geometry::EdgeAdjacency};
use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

#[test]
fn a_closed_part_of_the_scene_is_delivered_on_request() {
    let workbench = Workbench::with_frames(6);
    let crop = "box=-0.3,-0.3,0.2,0.3,0.3,0.9";
    let small = ["--voxel-size", "0.006"];
    let output = workbench.replay(&[&small[..], &["--crop", crop, "--watertight"]].concat());
    assert_says(&output, 0, &[]);
    let told = summary(&output);
    let base = read_ply(&workbench.path("out").join("base.ply")).unwrap();
    assert_eq!(told["base_mesh"]["faces"], base.faces.len());
    assert!(told["base_mesh"]["n_holes_filled"].as_u64().unwrap() > 0);
    assert!(EdgeAdjacency::new(&base).n_faces.iter().all(|&n| n == 2));
    let within = |p: &nalgebra::Point3<f64>| p.x.abs() < 0.31 && p.y.abs() < 0.31 && p.z < 0.91;
    assert!(base.faces.len() > 1000 && base.vertices.iter().all(within));
}

/// What a scan is refined into.
fn refined(scan: &Path, more: &[&str]) -> PathBuf {
    let out = scan.with_extension("refined");
    let fixed = [scan.to_str().unwrap(), "--out", out.to_str().unwrap()];
    let output = Command::new(PROGRAM)
        .arg("refine")
        .args(fixed)
        .args(more)
        .output()
        .unwrap();
    assert_says(&output, 0, &[]);
    assert!(!out.join("scene.ply").exists(), "it is kept with the scan");
    out.join("refined.ply")
}

/// A part alone, closed, is not what a refinement takes for measured: it begins with all that was fused, as the run itself did.
#[test]
fn what_is_refined_does_not_depend_on_what_was_delivered() {
    let workbench = Workbench::empty();
    let config = workbench.write("crop.toml", "[object]\ncrop = \"object\"\n");
    let config = ["--config", config.to_str().unwrap()];
    let [whole, part] = ["whole", "part"].map(|name| workbench.path(name));
    fused_demo(&whole);
    fuse(&demo(), &part, &["--crop", "object", "--watertight"]);
    assert!(part.join("scene.ply").exists() && !whole.join("scene.ply").exists());
    let of_whole = refined(&whole, &config);
    assert!(fs::read(&of_whole).unwrap() == fs::read(refined(&part, &config)).unwrap());

    // Without a crop of its own a refinement takes the part that was delivered: here the left half of the object.
    let mesh = read_ply(&of_whole).unwrap();
    let along = |axis: usize| mesh.vertices.iter().map(move |vertex| vertex[axis]);
    let least = [0, 1, 2].map(|axis| along(axis).fold(f64::INFINITY, f64::min) - 0.01);
    let most = [0, 1, 2].map(|axis| along(axis).fold(f64::NEG_INFINITY, f64::max) + 0.01);
    let middle = 0.5 * (least[0] + most[0]);
    let [x, y, z] = least;
    let crop = format!("box={x},{y},{z},{middle},{},{}", most[1], most[2]);
    let half = workbench.path("half");
    fuse(&demo(), &half, &["--crop", &crop]);
    let half = read_ply(&refined(&half, &[])).unwrap();
    assert!(half.faces.len() > 1000);
    assert!(half.vertices.iter().all(|vertex| vertex.x < middle + 0.005));
}

#[test]
fn a_crop_without_surface_delivers_the_whole_scene_and_says_so() {
    let workbench = Workbench::with_frames(4);
    let crop = "box=5,5,5,6,6,6";
    let output = workbench.replay(&["--voxel-size", "0.006", "--crop", crop]);
    assert_says(&output, 0, &[]);
    let told = summary(&output);
    assert!(told["base_mesh"]["faces"].as_u64().unwrap() > 1000);
    let warnings = told["warnings"].to_string();
    assert!(
        warnings.contains("base.ply is of the whole scene: no surface lies in the box"),
        "{warnings}"
    );
}

#[test]
fn given_poses_are_polished_on_request() {
    // Where a pixel is 6 mm wide rims are all that holds the plaque in its plane, and they find no model.
    let workbench = Workbench::empty();
    record(small_camera(3, 2), &workbench.session());
    let poses = workbench.path("poses.txt");
    let list = fs::read_to_string(workbench.session().join("depth.txt")).unwrap();
    let rows = list.lines().filter(|line| !line.starts_with('#'));
    let times = rows.filter_map(|line| line.split_whitespace().next());
    let camera = small_camera(3, 2);
    let first = camera.true_world_from_camera(0).inverse();
    // The last pose is 0.1 m too near, where nothing fits; it is not put right.
    let row = |(i, time): (usize, &str)| {
        let pose = first * camera.true_world_from_camera(i);
        let t = pose.translation.vector;
        let q = pose.rotation.coords;
        let z = t.z + if i == 2 { 0.1 } else { 0.0 };
        format!("{time} {} {} {z} {} {} {} {}", t.x, t.y, q.x, q.y, q.z, q.w)
    };
    let rows: Vec<String> = times.enumerate().map(row).collect();
    fs::write(&poses, rows.join("\n")).unwrap();
    let poses = poses.to_str().unwrap();
    let config = workbench.write("every-frame.toml", EVERY_FRAME);
    let config = [
        "--config",
        config.to_str().unwrap(),
        "--voxel-size",
        "0.006",
    ];
    let output = workbench.replay(&[&config[..], &["--poses", poses, "--polish-poses"]].concat());
    assert_says(&output, 0, &[]);
    let told = summary(&output);
    assert_eq!(told["frames"]["fused"], 3);
    assert_eq!(told["tracking"]["n_unpolished"], 1);
    assert!(
        told["warnings"]
            .to_string()
            .contains("1 frames were fused at their given pose")
    );
}

#[test]
fn polishing_needs_poses_and_a_crop_sense() {
    let workbench = Workbench::with_frames(1);
    let output = workbench.replay(&["--polish-poses"]);
    assert_says(&output, 2, &["--poses"]);
    let output = workbench.replay(&["--crop", "table"]);
    assert_says(&output, 2, &["neither none nor object nor box="]);
    let config = workbench.write(
        "bad.toml",
        "[object]\ncrop = { box = [0, 0, 0, 1, 0, 1] }\n",
    );
    let output = workbench.replay(&["--config", config.to_str().unwrap()]);
    assert_says(&output, 2, &["bad.toml", "object.crop", "ymin is 0"]);
}
