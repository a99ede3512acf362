//! The program as a service: its configuration, its unit, its man pages.

use crate::support::{EVERY_FRAME, PROGRAM, Workbench, assert_says};
use serde_json::Value;
use std::{
    fs,
    io::Read,
    os::{
        fd::{AsRawFd, OwnedFd},
        unix::{fs::MetadataExt, net::UnixStream},
    },
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
};

fn relief(arguments: &[&str]) -> Command {
    let mut command = Command::new(PROGRAM);
    command.args(arguments);
    command
}

fn printed(output: &Output) -> String {
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    String::from_utf8(output.stdout.clone()).unwrap()
}

#[test]
fn the_program_says_who_set_what() {
    let bench = Workbench::with_frames(1);
    let root = bench.path("machine");
    fs::create_dir_all(root.join("etc/relief/conf.d")).unwrap();
    let rig = root.join("etc/relief/conf.d/rig.toml");
    fs::write(&rig, "[fusion]\nvoxel_size_m = 0.004\n").unwrap();
    let show = |arguments: &[&str]| {
        let output = relief(&["config", "show"])
            .args(arguments)
            .env("RELIEF_CONFIG_ROOT", &root)
            .env("RELIEF_REFINE__N_ROUNDS", "3")
            .output();
        printed(&output.unwrap())
    };
    let lines = show(&["--origin"]);
    for line in [
        format!("fusion.voxel_size_m = 0.004  # {}:2", rig.display()),
        "refine.n_rounds = 3  # environment variable RELIEF_REFINE__N_ROUNDS".to_owned(),
        "worker.nice = 19  # default".to_owned(),
    ] {
        assert!(
            lines.lines().any(|found| found == line),
            "{line} in {lines}"
        );
    }
    let json: Value = serde_json::from_str(&show(&["--origin", "--json"])).unwrap();
    assert_eq!(json["refine.n_rounds"]["value"], 3);
    let json: Value = serde_json::from_str(&show(&["--json"])).unwrap();
    assert_eq!(json["fusion"]["voxel_size_m"], 0.004);
    // What is shown without origins is a configuration.
    let shown = bench.write("shown.toml", &show(&[]));
    let output = relief(&["config", "check", shown.to_str().unwrap()]).output();
    assert!(printed(&output.unwrap()).contains("shown.toml: valid"));
    // A level that there is none of is told of, and not taken for none.
    let output = relief(&["config", "check", shown.to_str().unwrap()])
        .env("RUST_LOG", "relief=loud")
        .output();
    assert_says(&output.unwrap(), 0, &["RUST_LOG: \"relief=loud\": "]);

    fs::write(&rig, "[fusion]\nvoxel_size_m = 4.0\n").unwrap();
    let output = relief(&["config", "check"])
        .env("RELIEF_CONFIG_ROOT", &root)
        .output();
    let piece = "rig.toml:2: fusion.voxel_size_m is 4, must be 0.0005 to 0.1";
    assert_says(&output.unwrap(), 2, &[piece]);
}

#[test]
fn man_pages_and_completions_know_the_sub_commands() {
    let bench = Workbench::with_frames(1);
    let folder = bench.path("man");
    printed(&relief(&["man", folder.to_str().unwrap()]).output().unwrap());
    let page = fs::read_to_string(folder.join("relief-refine.1")).unwrap();
    assert!(page.contains("progress") && !page.contains("max\\-memory\\-mb"));
    for shell in ["bash", "zsh", "fish"] {
        let text = printed(&relief(&["completions", shell]).output().unwrap());
        assert!(
            text.contains("calibrate") && text.contains("config"),
            "{shell}"
        );
    }
}

#[test]
fn log_lines_are_json_on_request() {
    let bench = Workbench::with_frames(2);
    let json = bench.replay(&["--log-format", "json"]);
    let lines = String::from_utf8(json.stderr).unwrap();
    let first = lines.lines().find(|line| line.starts_with('{')).unwrap();
    let line: Value = serde_json::from_str(first).unwrap();
    assert!(line["timestamp"].is_string() && line["level"].is_string());
}

#[test]
fn log_lines_for_the_journal_have_a_priority_and_neither_time_nor_colour() {
    let bench = Workbench::with_frames(2);
    let (mut journal, stderr) = UnixStream::pair().unwrap();
    let socket = fs::metadata(format!("/proc/self/fd/{}", stderr.as_raw_fd())).unwrap();
    let out = bench.path("out");
    let config = bench.write("every-frame.toml", EVERY_FRAME);
    let mut command = relief(&["replay", "--no-refine", "--json"]);
    command
        .args([bench.session(), "--out".into(), out])
        .args(["--config".into(), config])
        .env(
            "JOURNAL_STREAM",
            format!("{}:{}", socket.dev(), socket.ino()),
        )
        .stdout(Stdio::null())
        .stderr(OwnedFd::from(stderr));
    let mut child = command.spawn().unwrap();
    // It holds the other end, and with it the journal would not end.
    drop(command);
    let mut text = String::new();
    journal.read_to_string(&mut text).unwrap();
    assert!(child.wait().unwrap().success());
    let calibration = text.lines().find(|line| line.contains("calibration"));
    assert!(calibration.unwrap().starts_with("<6>calibration"), "{text}");
    assert!(!text.contains('\u{1b}') && !text.contains("INFO"), "{text}");
}

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("config")
        .join(name)
}

/// Runs systemd's analysis; nothing where it is not installed.
fn systemd_analyze(arguments: &[&str]) -> Option<Output> {
    match Command::new("systemd-analyze").args(arguments).output() {
        Ok(output) => Some(output),
        Err(error) => {
            eprintln!("skipped: systemd-analyze does not run: {error}");
            None
        }
    }
}

#[test]
fn the_unit_is_hardened() {
    let unit = file("relief.service");
    let unit = unit.to_str().unwrap();
    let threshold = [
        "security",
        "--offline=true",
        "--no-pager",
        "--threshold=20",
        unit,
    ];
    if let Some(output) = systemd_analyze(&threshold) {
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{said}");
        assert!(
            said.contains("Overall exposure level for relief.service"),
            "{said}"
        );
    }
}

#[test]
fn the_unit_lets_the_daemon_outlive_its_refinement_and_gives_it_threads_for_many_processors() {
    let unit = fs::read_to_string(file("relief.service")).unwrap();
    let setting = |key: &str| {
        let mut values = unit.lines().filter_map(|line| line.strip_prefix(key));
        values.next().unwrap()
    };
    assert_eq!(setting("OOMPolicy="), "continue");
    // Tracking, loops, refinement and a pool beside them, in the daemon and in its child.
    let (n_pools, n_processors) = (2 * 4, 256);
    let max_tasks: usize = setting("TasksMax=").parse().unwrap();
    assert!(max_tasks > n_pools * n_processors);
}

#[test]
fn the_units_are_well_formed() {
    let folder = tempfile::tempdir().unwrap();
    let mut units = Vec::new();
    for name in ["relief.service", "relief.socket"] {
        // The installed program is not there: verification wants one that is.
        let text = fs::read_to_string(file(name)).unwrap();
        let text = text.replace("/usr/bin/relief", PROGRAM);
        let unit = folder.path().join(name);
        fs::write(&unit, text).unwrap();
        units.push(unit.to_str().unwrap().to_owned());
    }
    let arguments: Vec<&str> = ["verify", "--man=no", "--recursive-errors=no"]
        .into_iter()
        .chain(units.iter().map(String::as_str))
        .collect();
    if let Some(output) = systemd_analyze(&arguments) {
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(
            output.status.success() && !said.contains("relief."),
            "{said}"
        );
    }
}
