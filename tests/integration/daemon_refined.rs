//! What a scan of the daemon comes to: a refined mesh, whatever was asked of it on the way, or less where that was asked for.

use crate::{
    daemon_process::Daemon,
    http_client::Client,
    support::{PROGRAM, Workbench, assert_says, demo, poll, prolong},
    worker::{child_of, send},
};
use serde_json::{Value, json};
use std::{fmt::Write, fs, os::unix::fs::symlink, path::Path, process::Command};

/// As fine as it takes for a refined surface to be believed.
const FAIR: &str = "\
[multipath]
enabled = false
[fusion]
voxel_size_m = 0.004
[snapshot]
max_snapshots = 10
[refine]
edge_length_m = 0.003
[worker]
turns = \"shared\"
nice = 0
";

/// Lists the frames of the demo to and fro, ten minutes long: so slowly that a busy machine keeps up, and where it leaves frames out the
/// camera has not gone far. How many frames there are one way.
fn sway(session: &Path) -> usize {
    fs::create_dir(session).unwrap();
    for name in ["session.toml", "depth", "ir"] {
        symlink(demo().join(name), session.join(name)).unwrap();
    }
    let mut n_frames = 0;
    for kind in ["depth", "ir"] {
        let name = format!("{kind}.txt");
        let list = fs::read_to_string(demo().join(&name)).unwrap();
        let images = list.lines().filter(|line| !line.starts_with('#'));
        let images = images.map(|line| line.split_once(' ').unwrap().1);
        let there: Vec<&str> = images.collect();
        n_frames = there.len();
        let back = there[1..n_frames - 1].iter().rev();
        let mut longer = String::new();
        for (frame, image) in there.iter().chain(back).cycle().take(1800).enumerate() {
            writeln!(longer, "{:.6} {image}", 100.0 + frame as f64 / 3.0).unwrap();
        }
        fs::write(session.join(name), longer).unwrap();
    }
    n_frames
}

/// Asks something of the scan, again while nothing is fused that it could be done with.
fn ask(client: Client, what: &str, body: &str) {
    let path = format!("/api/v1/scan/{what}");
    poll(what, || {
        let asked = client.post(&path, body);
        assert!(
            matches!(asked.status, 202 | 409 | 429 | 503),
            "{what}: {}",
            asked.status
        );
        (asked.status == 202).then_some(())
    });
}

/// Waits until the scan has told of an event.
fn await_event(scan: &Path, event: &str) {
    let told = format!("\"event\":\"{event}\"");
    poll(event, || {
        let events = fs::read_to_string(scan.join("events.jsonl")).ok()?;
        events.contains(&told).then_some(())
    });
}

/// Waits for the name under which a scan that goes on is refined.
fn interim_of(client: Client, id: &str) -> String {
    poll("the scan so far", || {
        let sessions = client.get("/api/v1/sessions").json();
        let mut sessions = sessions.as_array()?.iter();
        let interim = sessions.find(|session| session["interim_of"] == id)?;
        Some(interim["id"].as_str().unwrap().to_owned())
    })
}

/// Waits until a scan is refined.
fn await_refined(client: Client, id: &str) {
    poll("the refinement", || {
        let session = client.get(&format!("/api/v1/sessions/{id}")).json();
        let job = &session["job"];
        let state = job["state"].as_str()?;
        assert!(
            !matches!(state, "failed" | "refused" | "cancelled"),
            "{job}"
        );
        (state == "done").then_some(())
    });
}

#[test]
fn a_scan_is_refined_whatever_is_asked_of_it_on_the_way() {
    let bench = Workbench::empty();
    let n_frames = sway(&bench.session()) as u64;
    let config = bench.write("fair.toml", FAIR);
    let daemon = Daemon::start_in(bench, &["--config", config.to_str().unwrap()]);
    let client = daemon.client;
    let id = daemon.scan();
    let scan = daemon.bench.path("data/sessions").join(&id);
    ask(client, "reset", "");
    await_event(&scan, "reset");
    ask(client, "snapshot", "");
    ask(client, "undo", r#"{"secs":0.2}"#);
    await_event(&scan, "undone");
    daemon.await_status("all shading images, and frames from everywhere", |status| {
        let (snapshots, frames) = (&status["snapshots"], &status["frames"]);
        snapshots["accepted"] == snapshots["wanted"] && frames["fused"].as_u64() >= Some(n_frames)
    });
    ask(client, "refine", "");
    // How much would come until it is refined depends on how busy the machine is.
    ask(client, "pause", "");
    let interim = interim_of(client, &id);
    await_refined(client, &interim);
    assert_eq!(client.status()["scan"]["id"], id);

    ask(client, "finish", "");
    daemon.await_state("idle");
    await_refined(client, &id);
    for (name, beginning) in [("refined.ply", b"ply\n"), ("refined.glb", b"glTF")] {
        let file = client.get(&format!("/api/v1/sessions/{id}/files/{name}"));
        assert_eq!((file.status, &file.body[..4]), (200, &beginning[..]));
    }
    for which in ["refined", "difference"] {
        client.get(&client.mesh_of(&id, which)).assert_mesh();
    }
    let again = client.post(&format!("/api/v1/sessions/{id}/refine"), "");
    assert_eq!(again.status, 202);
    // By the same settings it would become the same.
    assert_eq!(again.json()["state"], "done");
}

#[test]
fn a_refinement_that_waits_behind_another_can_be_cancelled() {
    let bench = Workbench::with_frames(1);
    prolong(&bench.session());
    // Work enough for the child to be met, which then does nothing for as long as the test takes.
    let config = "[worker]\nmax_idle_secs = 86400.0\n[refine]\nedge_length_m = 0.0005\n";
    let config = bench.write("patient.toml", config);
    let daemon = Daemon::start_in(bench, &["--config", config.to_str().unwrap()]);
    let client = daemon.client;
    let scan = || {
        let id = daemon.scan();
        daemon.await_surface();
        ask(client, "finish", "");
        id
    };
    let first = scan();
    let folder = daemon.bench.path("data/sessions").join(&first);
    let child = poll("the refinement", || child_of(&folder));
    assert!(send("-STOP", &child));
    daemon.await_state("idle");
    let second = scan();
    let status = daemon.await_status("the refinement that waits", |status| {
        status["refinements_waiting"] == 1
    });
    assert_eq!(status["refinement"]["scan"], first);

    let session = client.get(&format!("/api/v1/sessions/{second}")).json();
    let job = session["job"]["id"].as_str().unwrap();
    let cancelled = client.post(&format!("/api/v1/jobs/{job}/cancel"), "");
    assert_eq!(cancelled.status, 200);
    assert_eq!(cancelled.json()["state"], "cancelled");
    let status = client.status();
    assert_eq!(status["refinements_waiting"], 0);
    assert_eq!(status["refinement"]["scan"], first);
    assert_eq!(status["refinement"]["state"], "running");
    drop(daemon);
    // One that was stopped before it had bound itself to the daemon is still there.
    send("-KILL", &child);
}

#[test]
fn an_abandoned_scan_keeps_its_frames_and_is_not_refined() {
    let daemon = Daemon::start(&["--record"]);
    let client = daemon.client;
    let id = daemon.scan();
    daemon.await_surface();
    ask(client, "abandon", "");
    daemon.await_state("idle");
    let session = client.get(&format!("/api/v1/sessions/{id}")).json();
    assert_eq!(
        (&session["state"], &session["job"]),
        (&json!("complete"), &Value::Null)
    );
    let scan = daemon.bench.path("data/sessions").join(&id);
    let verified = Command::new(PROGRAM)
        .args(["session", "verify"])
        .arg(scan.join("recording"))
        .output()
        .unwrap();
    assert_says(&verified, 0, &[]);
}
