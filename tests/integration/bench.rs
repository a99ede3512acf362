//! `relief bench` of a small recording.

use crate::support::{PROGRAM, Workbench, assert_says, summary};
use serde_json::Value;
use std::process::Command;

fn bench(bench: &Workbench) -> Value {
    let output = Command::new(PROGRAM)
        .args(["bench", bench.session().to_str().unwrap()])
        .args(["--voxel-size", "0.004", "--threads", "1", "--json"])
        .output()
        .unwrap();
    assert_says(&output, 0, &[]);
    summary(&output)
}

#[test]
fn every_step_is_timed_and_the_path_scored_where_it_is_known() {
    let workbench = Workbench::with_frames(3);
    let measured = bench(&workbench);
    let steps: Vec<&str> = measured["cpu_ms"]
        .as_array()
        .unwrap()
        .iter()
        .map(|time| time["step"].as_str().unwrap())
        .collect();
    assert_eq!(
        steps,
        [
            "preprocess",
            "raycast",
            "icp",
            "sdf_alignment",
            "allocate",
            "integrate",
            "remember"
        ]
    );
    assert_eq!(measured["frames"]["tracked"], 3);
    assert_eq!(measured["threads"], 1);
    assert_eq!(measured["cpu_ms"][0]["n_frames"], 3);
    // What is not in a step is the clock's.
    let steps = measured["cpu_ms"].as_array().unwrap().iter();
    let of_steps: f64 = steps.map(|time| time["mean_ms"].as_f64().unwrap()).sum();
    let of_frame = measured["frame_mean_cpu_ms"].as_f64().unwrap();
    assert!(
        of_steps > 0.8 * of_frame && of_steps < 1.001 * of_frame,
        "{of_steps} of {of_frame}"
    );
    for key in ["frame_cpu_ms", "frame_wall_ms", "fps", "model_bytes"] {
        assert!(measured[key].as_f64().unwrap() > 0.0, "{key}");
    }
    assert!(
        measured["peak_memory_bytes"].as_u64().unwrap()
            > measured["model_bytes"].as_u64().unwrap() / 2
    );
    let least = measured["fitness"]["least"].as_f64().unwrap();
    assert!(least > 0.3 && least <= measured["fitness"]["median"].as_f64().unwrap());
    for key in ["cpu_ms", "wall_ms", "patches"] {
        assert!(measured["live_mesh"][key].is_number(), "{key}");
    }
    for key in ["vertices", "faces", "cpu_ms", "wall_ms"] {
        assert!(measured["mesh"][key].is_number(), "{key}");
    }
    assert!(measured["trajectory"].is_null(), "no truth, no score");

    // A measured path is taken for the truth wherever it leads: three poses 1 m apart are far from a hand's motion.
    let list = std::fs::read_to_string(workbench.session().join("depth.txt")).unwrap();
    let rows: Vec<String> = list
        .lines()
        .filter(|line| !line.starts_with('#'))
        .filter_map(|line| line.split_whitespace().next())
        .enumerate()
        .map(|(i, time)| format!("{time} {i} 0 0 0 0 0 1"))
        .collect();
    std::fs::write(workbench.session().join("groundtruth.txt"), rows.join("\n")).unwrap();
    let trajectory = &bench(&workbench)["trajectory"];
    assert_eq!(trajectory["n_pairs"], 3);
    // About √(2/3) m: the camera hardly moves in three frames.
    let rmse_m = trajectory["rmse_m"].as_f64().unwrap();
    assert!((rmse_m - 0.816).abs() < 0.05, "{rmse_m}");
}

#[test]
fn a_damaged_frame_is_left_out_and_counted() {
    let workbench = Workbench::with_frames(3);
    let list = std::fs::read_to_string(workbench.session().join("depth.txt")).unwrap();
    let last = list.lines().last().unwrap().split_once(' ').unwrap().1;
    std::fs::write(workbench.session().join(last), "no image").unwrap();
    let frames = &bench(&workbench)["frames"];
    assert_eq!(
        (&frames["tracked"], &frames["damaged"]),
        (&2.into(), &1.into())
    );
}

#[test]
fn where_no_frame_is_tracked_there_is_no_rate() {
    let workbench = Workbench::with_frames(2);
    let config = workbench.write(
        "near.toml",
        "[fusion]\ndepth_min_m = 0.1\ndepth_max_m = 0.16\n",
    );
    let bench = |more: &[&str]| {
        let output = Command::new(PROGRAM)
            .args(["bench", workbench.session().to_str().unwrap()])
            .args(["--config", config.to_str().unwrap()])
            .args(more)
            .output()
            .unwrap();
        assert_says(&output, 0, &[]);
        output
    };
    let measured = summary(&bench(&["--json"]));
    assert_eq!(measured["frames"]["tracked"], 0);
    for key in ["frame_cpu_ms", "frame_mean_cpu_ms", "frame_wall_ms", "fps"] {
        assert_eq!(measured[key], Value::Null, "{key}");
    }
    let said = String::from_utf8(bench(&[]).stdout).unwrap();
    assert!(
        said.contains("0 tracked") && !said.contains("frames/s"),
        "{said}"
    );
}
