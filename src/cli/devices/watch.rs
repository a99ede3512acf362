//! `relief devices --watch`: Kinects as they come and go.

use super::{entry, print_entry};
use crate::cli::stdout::Stdout;
use relief::devices::{Kinect, Machine, list};
use serde_json::json;
use std::{
    io::{self, Write},
    path::Path,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};
use udev_monitor::UsbMonitor;

/// How long one wait for udev lasts, after which it is looked whether to stop.
const LISTEN: Duration = Duration::from_millis(100);

/// The bus is looked at so often even if udev says nothing: there may be none, and programs open devices without its knowing.
const LOOK_INTERVAL: Duration = Duration::from_secs(1);

/// Tells what has become of a Kinect.
pub type Tell = fn(what: &str, kinect: &Kinect) -> io::Result<()>;

/// Tells of all that is there, then of every change, until the flag is set.
pub fn watch(root: &Path, tell: Tell, stop: &AtomicBool) -> io::Result<()> {
    let machine = Machine::under(root);
    let mut monitor = UsbMonitor::open().ok();
    let mut known = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        let there = list(&machine);
        for kinect in known.iter().filter(|kinect| is_gone(kinect, &there)) {
            tell("removed", kinect)?;
        }
        for kinect in there.iter().filter(|kinect| !known.contains(kinect)) {
            let what = match is_gone(kinect, &known) {
                true => "added",
                false => "changed",
            };
            tell(what, kinect)?;
        }
        // Unlike `Stdout` this tells that nobody reads any more.
        io::stdout().flush()?;
        known = there;
        wait(&mut monitor, stop);
    }
    Ok(())
}

/// Whether the device, which gets another address each time it is plugged in, is not among those.
fn is_gone(kinect: &Kinect, there: &[Kinect]) -> bool {
    let place = |kinect: &Kinect| (kinect.camera.port.clone(), kinect.camera.address);
    there.iter().all(|other| place(other) != place(kinect))
}

/// Tells it as one JSON object on a line.
pub fn tell_json(what: &str, kinect: &Kinect) -> io::Result<()> {
    let object = json!({ "event": what, "device": entry(kinect) });
    writeln!(Stdout, "{object}")
}

/// Tells it as text.
pub fn tell_text(what: &str, kinect: &Kinect) -> io::Result<()> {
    write!(Stdout, "{what}: ")?;
    print_entry(&entry(kinect))
}

/// Returns when udev tells of a device, when it is time to look again, or soon after the flag is set.
fn wait(monitor: &mut Option<UsbMonitor>, stop: &AtomicBool) {
    let start = Instant::now();
    while start.elapsed() < LOOK_INTERVAL && !stop.load(Ordering::Relaxed) {
        match monitor.as_mut().map(|monitor| monitor.next(LISTEN)) {
            Some(Ok(Some(_))) => return,
            Some(Ok(None)) => {}
            Some(Err(error)) => {
                tracing::warn!(%error, "udev is not listened to any more");
                *monitor = None;
            }
            None => thread::sleep(LISTEN),
        }
    }
}
