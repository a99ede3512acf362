//! The daemon from outside: scans started, steered, finished and looked at by HTTP, requests that are refused, signals.

use crate::{
    daemon_process::{Daemon, refused},
    http_client::{Client, Message, Socket},
    support::{PROGRAM, Workbench, assert_says, poll, prolong},
};
use serde_json::{Value, json};
use std::{
    collections::BTreeSet,
    fs::{self, File},
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::Command,
};

fn assert_accounted(status: &Value) {
    let frames = status["frames"].as_object().unwrap();
    let count = |key: &str| frames[key].as_u64().unwrap();
    let elsewhere: u64 = frames
        .keys()
        .filter(|key| !matches!(key.as_str(), "produced" | "missed"))
        .map(|key| count(key))
        .sum();
    assert_eq!(elsewhere, count("produced"), "{frames:?}");
}

#[test]
fn a_scan_is_started_steered_and_finished() {
    let daemon = Daemon::start(&[]);
    let client = daemon.client;
    assert_eq!(client.status()["state"], "idle");
    client
        .post("/api/v1/scan/pause", "")
        .assert_problem(409, "not_scanning");

    let id = daemon.scan();
    let status = client.status();
    assert_eq!(status["scan"]["id"], id);
    assert_accounted(&status);
    client
        .post("/api/v1/scan", "{}")
        .assert_problem(409, "already_scanning");
    client
        .ask("DELETE", &format!("/api/v1/sessions/{id}"), &[], b"")
        .assert_problem(409, "scanning");

    assert_eq!(client.post("/api/v1/scan/pause", "").status, 202);
    let paused = daemon.await_status("paused frames", |status| {
        status["state"] == "paused" && status["frames"]["paused"].as_u64() > Some(0)
    });
    assert_accounted(&paused);
    client
        .post("/api/v1/scan/pause", "")
        .assert_problem(409, "already_paused");
    client
        .post("/api/v1/scan/undo", r#"{"secs":-1}"#)
        .assert_problem(400, "bad_undo");
    assert_eq!(client.post("/api/v1/scan/resume", "").status, 202);
    let fused = |status: &Value| status["frames"]["fused"].as_u64().unwrap();
    daemon.await_status("a frame after the pause", |status| {
        fused(status) > fused(&paused)
    });
    // One that ended before would be told of as failed.
    daemon.await_surface();

    assert_eq!(client.post("/api/v1/scan/finish", "").status, 202);
    daemon.await_state("idle");
    let session = client.get(&format!("/api/v1/sessions/{id}")).json();
    assert_eq!(
        (&session["state"], &session["failures"]),
        (&json!("complete"), &json!([]))
    );
    assert!(session["report"]["frames"]["fused"].as_u64() > Some(0));
    assert_eq!(
        client
            .get("/api/v1/sessions")
            .json()
            .as_array()
            .unwrap()
            .len(),
        1
    );
    look_at_files(client, &id);

    let jobs = client.get("/api/v1/jobs").json();
    assert!(
        jobs.as_array()
            .unwrap()
            .iter()
            .any(|job| job["scan"] == *id),
        "{jobs}"
    );
    remove(client, &id);
}

fn look_at_files(client: Client, id: &str) {
    let base = client.get(&format!("/api/v1/sessions/{id}/files/base.ply"));
    assert_eq!((base.status, &base.body[..4]), (200, &b"ply\n"[..]));
    let report = client.get(&format!("/api/v1/sessions/{id}/files/report.html"));
    assert!(
        report
            .header("content-security-policy")
            .unwrap()
            .contains("sandbox")
    );
    for name in [
        "scan.json",
        "..%2F..%2Fdaemon.lock",
        "%2Fetc%2Fpasswd",
        "calibration.toml",
    ] {
        let answer = client.get(&format!("/api/v1/sessions/{id}/files/{name}"));
        answer.assert_problem(404, "not_found");
    }
    let place = client.mesh_of(id, "base");
    let mesh = client.get(&place);
    mesh.assert_mesh();
    assert!(mesh.header("cache-control").unwrap().contains("immutable"));
    let tag = mesh.header("etag").unwrap();
    assert_eq!(
        client
            .ask("GET", &place, &[("If-None-Match", tag)], b"")
            .status,
        304
    );
}

#[test]
fn a_disk_that_is_full_when_a_scan_ends_is_waited_for() {
    let daemon = Daemon::start(&[]);
    let client = daemon.client;
    let id = daemon.scan();
    daemon.await_surface();
    let scan = daemon.bench.path("data/sessions").join(&id);
    // The first write finds no room; its end takes the link away.
    for name in [".base.ply.partial", ".scan.json.partial"] {
        symlink("/dev/full", scan.join(name)).unwrap();
    }
    assert_eq!(client.post("/api/v1/scan/finish", "").status, 202);
    let status = daemon.await_status("the refusal", |status| {
        status["storage_error"].is_string() && status["reason"] == "storage_failed"
    });
    let error = status["storage_error"].as_str().unwrap();
    assert!(error.contains("base.ply"), "{error}");
    assert_eq!(status["state"], "fault");
    // A daemon that is killed before the end is written down leaves a scan that is refined all the same.
    daemon.await_status("the refusal of the end", |status| {
        let error = status["storage_error"].as_str();
        error.is_some_and(|error| error.contains("scan.json"))
    });
    let jobs = client.get("/api/v1/jobs").json();
    assert_eq!(jobs[0]["scan"], id);
    let status = daemon.await_state("idle");
    assert!(status["storage_error"].is_null());
    let session = client.get(&format!("/api/v1/sessions/{id}")).json();
    assert_eq!(session["state"], "complete", "{session}");
    assert!(scan.join("base.ply").is_file());
}

#[test]
fn no_scan_starts_without_room() {
    let daemon = Daemon::start_wanting(1_000_000, Workbench::with_frames(1), &[]);
    let client = daemon.client;
    client.get("/readyz").assert_problem(503, "storage_failed");
    client
        .post("/api/v1/scan", "{}")
        .assert_problem(503, "storage_failed");
    assert_eq!(client.status()["state"], "idle");
}

/// Cancels what is asked for of a scan, and removes it.
fn remove(client: Client, id: &str) {
    let job = client.get(&format!("/api/v1/sessions/{id}")).json()["job"]["id"].clone();
    let job = job.as_str().unwrap();
    // It may be over already.
    client.post(&format!("/api/v1/jobs/{job}/cancel"), "");
    let address = format!("/api/v1/sessions/{id}");
    poll("the scan's removal", || {
        let removed = client.ask("DELETE", &address, &[], b"");
        (removed.status == 204).then_some(())
    });
    client.get(&address).assert_problem(404, "not_found");
}

#[test]
fn what_is_seen_of_a_scan_is_newest_and_complete() {
    let daemon = Daemon::start(&[]);
    let client = daemon.client;
    let mut events = client.events();
    client
        .get("/api/v1/scan/mesh")
        .assert_problem(409, "not_scanning");
    daemon.scan();

    let mesh = poll("the live mesh", || {
        let answer = client.get("/api/v1/scan/mesh?lod=preview");
        // The first is made before any surface is believed, and has nothing but a head.
        (answer.status == 200 && answer.body.len() > 16).then_some(answer)
    });
    mesh.assert_mesh();
    assert!(mesh.header("x-mesh-revision").is_some());
    client
        .get("/api/v1/scan/mesh?lod=tiny")
        .assert_problem(400, "bad_query");
    poll("the path", || {
        let path = client.get("/api/v1/scan/path").json();
        let poses = path["poses"].as_array().unwrap().len();
        (poses > 0 && path["last_good"].is_array()).then_some(())
    });

    let mut socket = client.socket(&[]).ok().unwrap();
    socket.say(r#"{"type":"want","previews":true}"#);
    let (mut has_status, mut kinds) = (false, [false; 4]);
    while !(has_status && kinds == [false, true, true, true]) {
        match socket.hear().expect("a message") {
            Message::Text(text) => {
                let status: Value = serde_json::from_str(&text).unwrap();
                assert_eq!(status["type"], "status");
                has_status = true;
            }
            Message::Binary(bytes) => kinds[usize::from(bytes[0])] = true,
        }
    }
    let told = events.find(|line| line.starts_with("data: ") && line.contains("tracking"));
    assert!(told.is_some());
}

/// The frames of the depth images that a socket brings, up to one at least so late.
fn frames_shown(socket: &mut Socket, last: u32) -> Vec<u32> {
    let mut frames: Vec<u32> = Vec::new();
    while frames.last().is_none_or(|&frame| frame < last) {
        if let Message::Binary(bytes) = socket.hear().expect("a message")
            && bytes[0] == 1
        {
            frames.push(u32::from_le_bytes(bytes[4..8].try_into().unwrap()));
        }
    }
    frames
}

#[test]
fn a_slow_reader_holds_up_nobody() {
    let daemon = Daemon::start(&[]);
    let client = daemon.client;
    let mut deaf: Vec<_> = (0..8).map(|_| client.socket(&[]).ok().unwrap()).collect();
    for socket in &mut deaf {
        socket.say(r#"{"type":"want","previews":true}"#);
    }
    assert_eq!(client.socket(&[]).err(), Some(503));
    daemon.scan();
    let status = daemon.await_status("a hundred frames", |status| {
        status["frames"]["produced"].as_u64() > Some(100)
    });
    assert_accounted(&status);
    assert_eq!(status["daemon"]["clients"], 8);
    let frames = frames_shown(&mut deaf[0], 100);
    assert!(frames.is_sorted_by(|one, next| one < next), "{frames:?}");
    deaf.truncate(4);
    daemon.await_status("clients that left", |status| {
        status["daemon"]["clients"] == 4
    });
}

#[test]
fn what_makes_no_sense_is_refused_with_a_code() {
    let daemon = Daemon::start(&[]);
    let client = daemon.client;
    let own = format!("http://{}", client.0);
    let ask =
        |method: &str, path: &str, headers: &[(&str, &str)]| client.ask(method, path, headers, b"");

    ask("GET", "/", &[("Host", "evil.example")]).assert_problem(421, "foreign_host");
    ask(
        "GET",
        "/api/v1/status",
        &[("Origin", "http://evil.example")],
    )
    .assert_problem(403, "foreign_origin");
    ask("POST", "/api/v1/scan", &[("Origin", "null")]).assert_problem(403, "foreign_origin");
    assert_eq!(
        ask("GET", "/api/v1/status", &[("Origin", &own)]).status,
        200
    );
    assert_eq!(
        client.socket(&[("Origin", "http://evil.example")]).err(),
        Some(403)
    );
    assert!(client.socket(&[("Origin", &own)]).is_ok());

    client.get("/api/v2").assert_problem(404, "not_found");
    client
        .get("/assets/..%2Fmod.rs")
        .assert_problem(404, "not_found");
    client
        .get("/api/v1/sessions/..")
        .assert_problem(404, "not_found");
    for address in [
        "/assets/%FF",
        "/api/v1/sessions/%FF",
        "/api/v1/sessions/%FF/mesh",
        "/api/v1/meshes/%FF",
        "/api/v1/scan/snapshots/%FF",
    ] {
        client.get(address).assert_problem(404, "not_found");
    }
    client
        .get("/api/v1/jobs/1/cancel")
        .assert_problem(405, "method_not_allowed");
    client.get("/api/v1/ws").assert_problem(400, "no_websocket");
    client
        .post("/api/v1/jobs/1/cancel", "")
        .assert_problem(404, "not_found");
    client
        .post("/api/v1/scan", "{")
        .assert_problem(400, "bad_body");
    for body in [r#"{"path":"/"}"#, r#" ["vase"]"#, "7"] {
        client
            .post("/api/v1/scan", body)
            .assert_problem(400, "bad_body");
    }
    let label = json!({ "label": "x".repeat(201) }).to_string();
    client
        .post("/api/v1/scan", &label)
        .assert_problem(400, "bad_label");
    let long = vec![b' '; 64 * 1024 + 1];
    client
        .ask("POST", "/api/v1/scan", &[], &long)
        .assert_problem(413, "body_too_long");

    let page = client.get("/");
    assert_eq!(page.status, 200);
    assert!(
        page.header("content-security-policy")
            .unwrap()
            .starts_with("default-src 'self';")
    );
    assert_eq!(page.header("x-content-type-options"), Some("nosniff"));
    assert_eq!(client.status()["state"], "idle");
}

/// Methods and paths in the first column of the table of `docs/api.md`, where a row may give the beginning of a path once.
fn documented_routes() -> BTreeSet<(String, String)> {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/api.md");
    let page = fs::read_to_string(page).unwrap();
    let (_, table) = page.split_once("## Routes\n").unwrap();
    let (table, _) = table.split_once("\n## ").unwrap();
    let mut routes = BTreeSet::new();
    for row in table.lines().filter_map(|line| line.strip_prefix("| `")) {
        let (named, _) = row.split_once("` | ").unwrap();
        let (mut method, mut path) = (String::new(), String::new());
        let pieces = named.split('`').step_by(2);
        for piece in pieces.filter(|piece| !piece.starts_with('{')) {
            match piece.split_once(' ') {
                Some((verb, whole)) => {
                    method = verb.to_lowercase();
                    path = whole.to_owned();
                }
                None if piece.starts_with('/') => path = format!("/api/v1{piece}"),
                None => {
                    let (beginning, _) = path.rsplit_once('/').unwrap();
                    path = format!("{beginning}/{piece}");
                }
            }
            let path = path.split('?').next().unwrap();
            routes.insert((method.clone(), path.to_owned()));
        }
    }
    routes
}

#[test]
fn every_route_is_described_and_documented() {
    let daemon = Daemon::start(&[]);
    let document = daemon.client.get("/api/v1/openapi.json").json();
    assert!(document["openapi"].as_str().unwrap().starts_with("3.1"));
    let mut described = BTreeSet::new();
    for (path, methods) in document["paths"].as_object().unwrap() {
        for method in methods.as_object().unwrap().keys() {
            described.insert((method.clone(), path.clone()));
        }
    }
    assert_eq!(described, documented_routes());
    let metrics = daemon.client.get("/metrics");
    let metrics = String::from_utf8(metrics.body).unwrap();
    for line in [
        "relief_tracking_state{state=\"idle\"} 1.0",
        "relief_frames_total{outcome=\"fused\"} 0",
        "relief_frames_missed_total 0",
        "relief_frames_unaccounted 0.0",
        "relief_snapshots_kept 0.0",
        "# EOF",
    ] {
        assert!(
            metrics.lines().any(|found| found == line),
            "{line} in {metrics}"
        );
    }
    assert_eq!(daemon.client.get("/healthz").status, 200);
    assert_eq!(daemon.client.get("/readyz").status, 200);
}

/// Brings a daemon into a state.
type Bring = fn(&Daemon);

#[test]
fn a_signal_finishes_what_is_scanned_paused_or_ending_and_ends_the_daemon() {
    let bring_into: [(&str, Bring); 4] = [
        ("idle", |_| ()),
        ("tracking", |daemon| drop(daemon.scan())),
        ("paused", |daemon| {
            daemon.scan();
            daemon.client.post("/api/v1/scan/pause", "");
            daemon.await_state("paused");
        }),
        ("draining", |daemon| {
            daemon.scan();
            assert_eq!(daemon.client.post("/api/v1/scan/finish", "").status, 202);
        }),
    ];
    for (state, bring) in bring_into {
        let daemon = Daemon::start(&[]);
        bring(&daemon);
        daemon.signal("-TERM");
        let (bench, status) = daemon.wait();
        assert_eq!(status.code(), Some(0), "{state}");
        let scans = sessions(&bench);
        assert_eq!(scans.len(), usize::from(state != "idle"), "{state}");
        for scan in scans {
            for name in ["base.ply", "report.json"] {
                assert!(scan.join(name).is_file(), "{state}: {name}");
            }
            assert!(!scan.join(".relief.lock").exists(), "{state}");
            let record = fs::read_to_string(scan.join("scan.json")).unwrap();
            let record: Value = serde_json::from_str(&record).unwrap();
            assert!(record["ended_unix_ms"].is_u64(), "{state}");
        }
    }
}

fn sessions(bench: &Workbench) -> Vec<PathBuf> {
    let folder = bench.path("data/sessions");
    let entries = fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().path()).collect()
}

#[test]
fn a_configuration_is_read_anew_and_a_bad_one_is_told_of() {
    let bench = Workbench::with_frames(1);
    let config = bench.write("relief.toml", "[fusion]\nvoxel_size_m = 0.004\n");
    let daemon = Daemon::start_in(bench, &["--config", config.to_str().unwrap()]);
    let client = daemon.client;
    let voxel_size =
        || client.get("/api/v1/config").json()["config"]["fusion"]["voxel_size_m"].clone();
    fs::write(&config, "[fusion]\nvoxel_size_m = 0\n").unwrap();
    daemon.signal("-HUP");
    let status = daemon.await_status("the error", |status| {
        !status["daemon"]["config_error"].is_null()
    });
    let error = status["daemon"]["config_error"].as_str().unwrap();
    assert!(
        error.contains("fusion.voxel_size_m is 0, must be"),
        "{error}"
    );
    client
        .post("/api/v1/config/reload", "")
        .assert_problem(409, "bad_config");
    assert_eq!(voxel_size(), 0.004);
    fs::write(&config, "[fusion]\nvoxel_size_m = 0.005\n").unwrap();
    assert_eq!(client.post("/api/v1/config/reload", "").status, 200);
    assert_eq!(voxel_size(), 0.005);
    assert!(client.status()["daemon"]["config_error"].is_null());
}

#[test]
fn a_daemon_that_cannot_start_says_why() {
    let daemon = Daemon::start(&[]);
    let (code, said) = refused(&daemon.bench, &[]);
    assert_eq!(code, Some(5), "{said}");
    assert!(said.contains("is in use by another daemon"), "{said}");
    assert_eq!(daemon.client.status()["state"], "idle");

    let bench = Workbench::with_frames(1);
    // Somebody else's, for now.
    let address = daemon.client.0.to_string();
    let (code, said) = refused(&bench, &["--listen", &address]);
    assert_eq!(code, Some(70), "{said}");
    assert!(said.contains("cannot listen on"), "{said}");
    let config = bench.write("bad.toml", "[fusion]\nvoxel_size_m = 0\n");
    let (code, said) = refused(&bench, &["--config", config.to_str().unwrap()]);
    assert_eq!(code, Some(3), "{said}");
    let token = bench.path("data/token");
    fs::create_dir_all(token.parent().unwrap()).unwrap();
    fs::write(&token, "short").unwrap();
    let (code, said) = refused(&bench, &["--require-token"]);
    assert_eq!(code, Some(3), "{said}");
    assert!(said.contains("data/token holds no token"), "{said}");
    fs::remove_file(bench.session().join("session.toml")).unwrap();
    let (code, said) = refused(&bench, &[]);
    assert_eq!(code, Some(4), "{said}");
    assert!(said.contains("session.toml"), "{said}");
}

#[test]
fn more_threads_than_any_machine_has_are_refused_everywhere() {
    for command in [
        &["run"][..],
        &["replay", "session", "--out", "out"],
        &["refine", "out", "--out", "refined"],
        &["evaluate", "out", "--out", "evaluation"],
        &["bench", "session"],
    ] {
        let output = Command::new(PROGRAM)
            .args(command)
            .args(["--threads", "100000"])
            .output()
            .unwrap();
        assert_says(&output, 2, &["100000 threads, must be 1 to 1024"]);
    }
}

/// A recording in the data directory, as a daemon that was killed leaves it.
fn left_open(bench: &Workbench, scan: &str) -> PathBuf {
    let recording = bench.path("data/sessions").join(scan).join("recording");
    let imported = Command::new(PROGRAM)
        .args(["session", "import"])
        .arg(bench.session())
        .arg("--out")
        .arg(&recording)
        .output()
        .unwrap();
    assert_says(&imported, 0, &[]);
    let record = recording.join("session.json");
    let text = fs::read_to_string(&record).unwrap();
    fs::write(record, text.replace("\"closed\"", "\"open\"")).unwrap();
    recording
}

fn recording_state(recording: &Path) -> Value {
    let record = fs::read(recording.join("session.json")).unwrap();
    let record: Value = serde_json::from_slice(&record).unwrap();
    record["state"].clone()
}

#[test]
fn recordings_that_were_left_open_are_mended_while_the_daemon_answers() {
    let bench = Workbench::with_frames(1);
    let [small, large] = ["a", "b"].map(|scan| left_open(&bench, scan));
    prolong(&bench.session());
    // Torn in its first record, with a terabyte of nothing behind: that takes no room, and longer to read than anybody waits.
    let segment = File::options()
        .write(true)
        .open(large.join("segment-0000.mcap"))
        .unwrap();
    for n_bytes in [12, 1 << 40] {
        segment.set_len(n_bytes).unwrap();
    }
    let daemon = Daemon::start_in(bench, &[]);
    poll("the repair", || {
        (recording_state(&small) == "repaired").then_some(())
    });
    assert_eq!(daemon.client.status()["state"], "idle");
    daemon.signal("-TERM");
    let (_bench, status) = daemon.wait();
    assert_eq!(status.code(), Some(0));
    // It is done again by the next daemon.
    assert_eq!(recording_state(&large), "open");
}
