//! The daemon with a live device on the unmodified libfreenect: scans one after the other, steered over HTTP, unplugged meanwhile.

use super::{
    scan::SERIAL,
    snapshots::still_before_the_plaque,
    stand_in::{Bus, Running},
};
use crate::{http_client::Client, support::poll};
use serde_json::Value;
use std::{fs, path::Path};

const SETTINGS: &str = "[capture]\nshading = \"stop_depth\"\nmin_free_disk_mb = 0\n[fusion]\nvoxel_size_m = 0.004\n\
     [devices.kinect1]\nir_gain = 12\nlamp_position_m = [0.12, -0.07, 0.02]\n";

/// A daemon that scans with the device, and where it listens.
fn start(bus: &Bus) -> (Running, Client) {
    let (settings, data) = (bus.path("relief.toml"), bus.path("data"));
    fs::write(&settings, SETTINGS).unwrap();
    let arguments = ["run", "--device", SERIAL, "--listen", "127.0.0.1:0"];
    let paths = [
        ["--config", settings.to_str().unwrap()],
        ["--data", data.to_str().unwrap()],
    ];
    let arguments = [&arguments, paths.as_flattened()].concat();
    let mut daemon = Running::start(bus, "daemon.log", bus.relief(&arguments));
    let address = || -> Option<Client> {
        let text = fs::read_to_string(bus.path("data/daemon.lock")).ok()?;
        let address = text.strip_prefix("http://")?.strip_suffix("/\n")?;
        address.parse().ok().map(Client)
    };
    daemon.wait_until("it listens", |_| address().is_some());
    (daemon, address().unwrap())
}

fn await_status(client: Client, what: &str, holds: impl Fn(&Value) -> bool) -> Value {
    poll(what, || Some(client.status()).filter(&holds))
}

fn fused(status: &Value) -> u64 {
    status["frames"]["fused"].as_u64().unwrap()
}

fn ask(client: Client, what: &str) {
    let answer = client.post(&format!("/api/v1/scan/{what}"), "");
    assert_eq!(answer.status, 202, "{what}");
}

/// Starts a scan that fuses frames; its name.
fn scan(client: Client) -> String {
    let started = client.post("/api/v1/scan", "{}");
    assert_eq!(started.status, 201);
    await_status(client, "frames", |status| fused(status) >= 3);
    started.json()["id"].as_str().unwrap().to_owned()
}

fn meta(session: &Path) -> Value {
    let text = fs::read_to_string(session.join("snapshots/000/meta.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

#[test]
fn the_daemon_scans_with_a_device_again_and_again() {
    let bus = still_before_the_plaque(true);
    let (daemon, client) = start(&bus);
    let first = scan(client);
    ask(client, "snapshot");
    let taken = await_status(client, "a shading image", |status| {
        status["snapshots"]["accepted"] == 1
    });
    assert_eq!(taken["scan"]["device"]["serial"], SERIAL);

    bus.raise("kinect0", "unplugged");
    poll("it is missed", || {
        daemon.said().contains("the camera is gone").then_some(())
    });
    let missed = client.status();
    bus.lower("kinect0", "unplugged");
    await_status(client, "frames after plugging in", |status| {
        fused(status) >= fused(&missed) + 3
    });
    ask(client, "abandon");
    await_status(client, "the scan's end", |status| status["scan"].is_null());
    let session = client.get(&format!("/api/v1/sessions/{first}")).json();
    assert_eq!(session["state"], "complete", "{session}");
    assert_eq!(session["failures"], serde_json::json!([]));
    let frames = &session["report"]["frames"];
    eprintln!("{frames}");
    assert_eq!(frames["unaccounted"], 0);
    let meta = meta(&bus.path("data/sessions").join(&first));
    assert_eq!(meta["ir_gain"], 12);
    assert_eq!(meta["serial"], SERIAL);

    // The device was given back: another scan opens it anew, and ends with the daemon.
    let second = scan(client);
    assert_ne!(first, second);
    daemon.interrupt();
    assert!(
        bus.path("data/sessions")
            .join(&second)
            .join("base.ply")
            .is_file()
    );
}
