//! Shading images that the operator asks for, through the whole pipeline on the unmodified libfreenect: with depth stopped by the
//! program, and with the projector covered by hand.

use super::{
    scan::{SERIAL, device_params, scan_params},
    stand_in::{Bus, ZERO_PLANE_LINE, inside},
};
use crate::raw_kinect1::raw_frames;
use freenect1::streams::IrSize;
use relief::{
    capture::{CaptureParams, ShadingStrategy},
    devices::{DeviceParams, open},
    pipeline::{
        Command, CommandRefused, Ending, EventKind, Handle, OutputFolder, Pipeline, PipelineParams,
        Status, Watch, WhenFull,
    },
};
use simulated::SimulatedCamera;
use std::{
    fs,
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

/// Longest wait for what the pipeline does; the machine may be busy.
const PATIENCE: Duration = Duration::from_secs(120);

/// A camera that stands before the plaque: speckle on it while the projector is to be seen, the lamp alone otherwise, if it is lit.
pub fn still_before_the_plaque(is_lit: bool) -> Bus {
    let bus = Bus::new();
    let frames = raw_frames(SimulatedCamera::kinect1_plaque(8, 5));
    // Frame 6 is of the projector, those after it of the lamp from the same place.
    let device =
        format!("serial = {SERIAL}\nframe_rate_hz = 10\nfreeze_ir_clock = true\n{ZERO_PLANE_LINE}");
    bus.plug("kinect0", &device, &frames[6..7]);
    if is_lit {
        let lamp = frames[8].ir.as_ref().unwrap().data();
        let bytes: Vec<u8> = lamp.iter().flat_map(|count| count.to_le_bytes()).collect();
        fs::write(bus.path("kinect0/ir10-alone.u16"), bytes).unwrap();
    }
    bus
}

/// A scan with that device.
struct Scan {
    root: PathBuf,
    handle: Handle,
    watch: Watch,
}

impl Scan {
    /// Fused only, its infrared of the smaller size.
    fn begin(root: PathBuf, shading: ShadingStrategy) -> Self {
        let fused_only = PipelineParams {
            is_refined: false,
            ..scan_params()
        };
        Scan::with(root, shading, fused_only, &device_params())
    }

    fn with(
        root: PathBuf,
        shading: ShadingStrategy,
        params: PipelineParams,
        device: &DeviceParams,
    ) -> Self {
        let camera = open(SERIAL, device).unwrap();
        let folder = OutputFolder::claim(&root.join("out")).unwrap();
        let params = PipelineParams {
            when_full: WhenFull::Drop,
            capture: CaptureParams {
                shading,
                ..params.capture
            },
            ..params
        };
        let handle = Pipeline::spawn(camera, params, folder).unwrap();
        let watch = handle.watch();
        Scan {
            root,
            handle,
            watch,
        }
    }

    fn until(&self, what: &str, holds: impl Fn(&Status) -> bool) -> Status {
        let start = Instant::now();
        loop {
            let status = self.watch.status();
            // At every moment, whatever is going on.
            assert_eq!(status.frames.unaccounted(), 0, "{:?}", status.frames);
            if holds(&status) {
                return status;
            }
            assert!(start.elapsed() < PATIENCE, "{what}: {status:?}");
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits until so many more frames are in the model.
    fn fuse(&self, n_frames: u64) {
        let n_fused = self.watch.status().frames.fused;
        self.until("frames are fused", |status| {
            status.frames.fused >= n_fused + n_frames
        });
    }

    fn ask(&self) -> Result<(), CommandRefused> {
        self.watch.command(Command::Snapshot)
    }

    /// Why commands were refused, in order.
    fn refusals(&self) -> Vec<String> {
        let events = self.watch.events().since(0).into_iter();
        events
            .filter_map(|(_, event)| match &event.kind {
                EventKind::Refused { command, reason } => Some(format!("{command}: {reason}")),
                _ => None,
            })
            .collect()
    }

    /// Ends it; how many shading images it has, and where.
    fn finish(self) -> (usize, PathBuf) {
        self.watch.command(Command::Finish).unwrap();
        let outcome = self.handle.join();
        assert_eq!(outcome.failures, Vec::<String>::new());
        assert_eq!(outcome.ending, Ending::Complete);
        let accounts = self.watch.status().frames;
        eprintln!("{accounts:?}");
        assert_eq!((accounts.unaccounted(), accounts.in_flight), (0, 0));
        assert_eq!((accounts.damaged, accounts.lost), (0, 0));
        let folder = self.root.join("out/snapshots");
        let n_images = fs::read_dir(&folder).map_or(0, |entries| entries.count());
        (n_images, folder)
    }
}

/// What the library has told the device.
fn written(root: &Path) -> Vec<String> {
    let trace = fs::read_to_string(root.join("kinect0/trace.txt")).unwrap();
    assert!(
        !trace.contains("Motor") && !trace.contains("overrun"),
        "{trace}"
    );
    trace.lines().map(str::to_owned).collect()
}

fn count(written: &[String], line: &str) -> usize {
    written.iter().filter(|other| *other == line).count()
}

/// Asserts that a stored image is that of the lamp, bit by bit, with all that is known of how it was taken.
fn assert_lamp(root: &Path, image: &Path) {
    let sent = fs::read(root.join("kinect0/ir10-alone.u16")).unwrap();
    let stored = replay::read_png(&image.join("ir.png"), 640, 480).unwrap();
    let stored = stored.data().iter().flat_map(|count| count.to_le_bytes());
    assert!(stored.eq(sent[..640 * 480 * 2].iter().copied()));
    let meta = fs::read_to_string(image.join("meta.json")).unwrap();
    let meta: serde_json::Value = serde_json::from_str(&meta).unwrap();
    assert_eq!(meta["ir_gain"], 12);
    assert_eq!(
        meta["light_position_camera_m"],
        serde_json::json!([0.12, -0.07, 0.02])
    );
    assert!(meta["n_exposures"].as_u64().unwrap() >= 4, "{meta}");
    assert_eq!(meta["serial"], SERIAL);
}

/// Asks a scan for an image twice, between frames that are fused; both must be the lamp's.
fn take_two(scan: Scan, root: &Path) {
    scan.fuse(3);
    for n_images in 1..=2 {
        scan.ask().unwrap();
        scan.until("it is taken", |status| {
            status.snapshots.accepted == n_images && !status.is_snapshotting
        });
        scan.fuse(3);
    }
    assert_eq!(scan.refusals(), Vec::<String>::new());
    let (n_images, folder) = scan.finish();
    assert_eq!(n_images, 2);
    for image in ["000", "001"] {
        assert_lamp(root, &folder.join(image));
    }
}

#[test]
fn stopping_depth_gives_an_image_for_each_request() {
    let test = "live_devices::snapshots::stopping_depth_gives_an_image_for_each_request";
    let Some(root) = inside() else {
        return still_before_the_plaque(true).run_inside(test);
    };
    let scan = Scan::begin(root.clone(), ShadingStrategy::StopDepth);
    take_two(scan, &root);
    let written = written(&root);
    // Depth: started, stopped and started for each image, stopped in the end, and before each start by the library itself; IR goes
    // on all the time.
    assert_eq!(
        (count(&written, "write 06 2"), count(&written, "write 06 0")),
        (3, 6)
    );
    assert_eq!(
        (count(&written, "write 05 3"), count(&written, "write 05 0")),
        (1, 1)
    );
    assert_eq!(count(&written, "write 15 c"), 1, "{written:?}");
}

/// Four pixels for each of an image, whose means are its counts, and noise in the rows that the smaller image does not have.
fn spread(counts: &[u16]) -> Vec<u16> {
    let (width, height) = IrSize::High.pixels();
    let part = |u: usize, v: usize| {
        let count = counts[640 * (v / 2) + u / 2];
        let amount = count.min(1022 - count.min(1022)).min(9);
        match (u % 2, v % 2) {
            (0, 0) => count - amount,
            (1, 1) => count + amount,
            _ => count,
        }
    };
    let pixels = (0..width * height).map(|i| (i % width, i / width));
    pixels
        .map(|(u, v)| match v < 960 {
            true => part(u, v),
            false => ((u * 7919 + v * 104_729) % 1024) as u16,
        })
        .collect()
}

#[test]
fn exposures_of_full_size_become_images_of_the_depth_grid() {
    let test = "live_devices::snapshots::exposures_of_full_size_become_images_of_the_depth_grid";
    let Some(root) = inside() else {
        let bus = still_before_the_plaque(true);
        let lamp = fs::read(bus.path("kinect0/ir10-alone.u16")).unwrap();
        let lamp: Vec<u16> = lamp
            .chunks_exact(2)
            .map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
            .collect();
        let high: Vec<u8> = spread(&lamp)
            .into_iter()
            .flat_map(u16::to_le_bytes)
            .collect();
        fs::write(bus.path("kinect0/ir10-high.u16"), high).unwrap();
        return bus.run_inside(test);
    };
    let mut device = device_params();
    device.kinect1.stop_depth_ir_size = IrSize::High;
    let scan = Scan::with(
        root.clone(),
        ShadingStrategy::StopDepth,
        scan_params(),
        &device,
    );
    take_two(scan, &root);
    let report = fs::read_to_string(root.join("out/report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let refined = &report["refined_mesh"];
    let [before, after] = ["rmse_before", "rmse_after"].map(|key| refined[key].as_f64().unwrap());
    eprintln!("image error {before:.4} -> {after:.4}");
    assert_eq!(refined["views"].as_array().unwrap().len(), 2);
    assert!(after < before, "{before} -> {after}");
    let written = written(&root);
    // At full size for each image, and back; IR is stopped for it.
    assert_eq!(
        (count(&written, "write 1a 2"), count(&written, "write 1a 1")),
        (2, 3),
        "{written:?}"
    );
}

#[test]
fn stopping_depth_is_refused_while_speckle_shows() {
    let test = "live_devices::snapshots::stopping_depth_is_refused_while_speckle_shows";
    let Some(root) = inside() else {
        return still_before_the_plaque(false).run_inside(test);
    };
    let scan = Scan::begin(root.clone(), ShadingStrategy::StopDepth);
    scan.fuse(3);
    scan.ask().unwrap();
    scan.until("it is refused", |status| {
        !status.is_snapshotting && !scan.refusals().is_empty()
    });
    let refusals = scan.refusals();
    assert_eq!(refusals.len(), 1, "{refusals:?}");
    for piece in [
        "snapshot: the projector stays lit with depth stopped: speckle energy is ",
        "must be below 0.12",
        "set capture.shading to \"shutter\" and cover the projector",
    ] {
        assert!(refusals[0].contains(piece), "{refusals:?}");
    }
    // The scan goes on, and may be asked again; ending it meanwhile leaves nothing behind.
    scan.fuse(3);
    scan.ask().unwrap();
    scan.until("depth is stopped", |_| {
        count(&written(&root), "write 06 0") == 4
    });
    let (n_images, _) = scan.finish();
    assert_eq!(n_images, 0);
}

#[test]
fn a_covered_projector_gives_an_image_and_depth_runs_on() {
    let test = "live_devices::snapshots::a_covered_projector_gives_an_image_and_depth_runs_on";
    let Some(root) = inside() else {
        return still_before_the_plaque(true).run_inside(test);
    };
    let scan = Scan::begin(root.clone(), ShadingStrategy::Shutter);
    scan.fuse(3);
    scan.ask().unwrap();
    scan.until("it is awaited", |status| status.is_snapshotting);
    assert_eq!(scan.ask(), Err(CommandRefused::AlreadySnapshotting));
    let n_before = scan.watch.status().frames.without_depth;
    fs::write(root.join("kinect0/covered"), []).unwrap();
    scan.until("exposures are taken", |status| {
        status.frames.without_depth >= n_before + 5
    });
    fs::remove_file(root.join("kinect0/covered")).unwrap();
    scan.until("it is taken", |status| {
        status.snapshots.accepted == 1 && !status.is_snapshotting
    });
    scan.fuse(3);
    let (n_images, folder) = scan.finish();
    assert_eq!(n_images, 1);
    assert_lamp(&root, &folder.join("000"));
    let written = written(&root);
    assert_eq!(
        (count(&written, "write 06 2"), count(&written, "write 06 0")),
        (1, 2)
    );
}

#[test]
fn a_cover_that_lets_speckle_through_gives_no_image() {
    let test = "live_devices::snapshots::a_cover_that_lets_speckle_through_gives_no_image";
    let Some(root) = inside() else {
        return still_before_the_plaque(false).run_inside(test);
    };
    let scan = Scan::begin(root.clone(), ShadingStrategy::Shutter);
    scan.fuse(3);
    scan.ask().unwrap();
    fs::write(root.join("kinect0/covered"), []).unwrap();
    let status = scan.until("frames come without depth", |status| {
        status.frames.without_depth >= 5
    });
    let sequence = status.kinect1_sequence.unwrap();
    assert!(sequence.speckle > sequence.speckle_limit, "{sequence:?}");
    fs::remove_file(root.join("kinect0/covered")).unwrap();
    scan.fuse(3);
    let status = scan.watch.status();
    // The operator may take all the time there is.
    assert!(status.is_snapshotting && status.snapshots.accepted == 0);
    let (n_images, _) = scan.finish();
    assert_eq!(n_images, 0);
}
