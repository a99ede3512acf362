//! A daemon as a process, over a recording of a camera that stands still for a minute and begins anew.

use crate::{
    http_client::Client,
    support::{PROGRAM, Workbench, poll, prolong},
};
use serde_json::Value;
use std::{
    fs,
    io::Read,
    process::{Child, Command, ExitStatus, Stdio},
};

/// How much room a scan wants, MB.
const MIN_FREE_DISK_MB: &str = "RELIEF_CAPTURE__MIN_FREE_DISK_MB";
/// Voxels of about three of the small camera's pixels: among finer ones a camera that stands still is soon lost.
const COARSE_VOXELS: (&str, &str) = ("RELIEF_FUSION__VOXEL_SIZE_M", "0.025");

/// A running daemon; killed when dropped.
pub struct Daemon {
    pub bench: Workbench,
    pub client: Client,
    child: Child,
}

impl Daemon {
    /// Starts a daemon on a free port over a camera that stands still, and waits until it answers.
    pub fn start(arguments: &[&str]) -> Self {
        let bench = Workbench::with_frames(1);
        prolong(&bench.session());
        Self::start_wanting(0, bench, arguments)
    }

    /// Starts a daemon over the recording of a bench.
    pub fn start_in(bench: Workbench, arguments: &[&str]) -> Self {
        let command = command(&bench, arguments);
        Self::spawn(bench, command)
    }

    /// Starts a daemon over the recording of a bench, of a camera that stands still, whose scans want so much room on the disk, MB.
    pub fn start_wanting(min_free_disk_mb: u32, bench: Workbench, arguments: &[&str]) -> Self {
        let mut command = command(&bench, arguments);
        let (key, voxels) = COARSE_VOXELS;
        command.env(key, voxels);
        command.env(MIN_FREE_DISK_MB, min_free_disk_mb.to_string());
        Self::spawn(bench, command)
    }

    fn spawn(bench: Workbench, mut command: Command) -> Self {
        let mut child = command.stderr(Stdio::null()).spawn().unwrap();
        let lock = bench.path("data/daemon.lock");
        let client = poll("the daemon's address", || {
            assert_eq!(child.try_wait().unwrap(), None, "the daemon ended");
            let text = fs::read_to_string(&lock).ok()?;
            let address = text.split_once("://")?.1.strip_suffix("/\n")?;
            address.parse().ok().map(Client)
        });
        Daemon {
            bench,
            client,
            child,
        }
    }

    /// Starts a scan that fuses frames, and returns its name.
    pub fn scan(&self) -> String {
        let started = self.client.post("/api/v1/scan", "{}");
        assert_eq!(started.status, 201);
        self.await_status("a fused frame", |status| {
            status["frames"]["fused"].as_u64() > Some(0)
        });
        started.json()["id"].as_str().unwrap().to_owned()
    }

    /// Waits for a status and returns it.
    pub fn await_status(&self, what: &str, is_it: impl Fn(&Value) -> bool) -> Value {
        poll(what, || Some(self.client.status()).filter(&is_it))
    }

    /// Waits for a state by name.
    pub fn await_state(&self, state: &str) -> Value {
        self.await_status(state, |status| status["state"] == state)
    }

    /// Waits for a scan that can be refined: a shading image, and frames enough for a surface.
    pub fn await_surface(&self) -> Value {
        self.await_status("a surface with a shading image", |status| {
            let (accepted, frames) = (&status["snapshots"]["accepted"], &status["frames"]);
            accepted.as_u64() > Some(0) && frames["fused"].as_u64() > Some(10)
        })
    }

    /// Sends a signal.
    pub fn signal(&self, signal: &str) {
        let pid = self.child.id().to_string();
        let sent = Command::new("kill").args([signal, &pid]).status().unwrap();
        assert!(sent.success());
    }

    /// Waits for the end.
    pub fn wait(mut self) -> (Workbench, ExitStatus) {
        let status = poll("the daemon's end", || self.child.try_wait().unwrap());
        let bench = std::mem::replace(&mut self.bench, Workbench::empty());
        (bench, status)
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // A daemon that has ended cannot be killed, and need not be.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The command line of a daemon.
fn command(bench: &Workbench, arguments: &[&str]) -> Command {
    let mut command = Command::new(PROGRAM);
    command
        .arg("run")
        .arg("--replay")
        .arg(bench.session())
        .args(["--repeat", "--threads", "1"])
        .arg("--data")
        .arg(bench.path("data"))
        .args(arguments)
        // However full the disk is on which the tests run.
        .env(MIN_FREE_DISK_MB, "0")
        .stdout(Stdio::null());
    if !arguments.contains(&"--listen") {
        command.args(["--listen", "127.0.0.1:0"]);
    }
    command
}

/// Runs a daemon that does not start; its exit code and what it said.
pub fn refused(bench: &Workbench, arguments: &[&str]) -> (Option<i32>, String) {
    let mut child = command(bench, arguments)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = String::new();
    child
        .stderr
        .take()
        .unwrap()
        .read_to_string(&mut said)
        .unwrap();
    (child.wait().unwrap().code(), said)
}
