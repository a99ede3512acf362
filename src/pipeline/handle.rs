//! What the outside holds of a running pipeline: its newest status, a way to stop it, and its outcome.

use super::{
    command::{Command, CommandDesk, CommandRefused},
    deliver::Outbox,
    edges::DropCounts,
    event_log::EventLog,
    fusion_stage::{FusedScan, FusionSummary},
    live::Live,
    output_folder::OutputFolder,
    patience::Patience,
    pictures,
    refine_stage::RefineSummary,
    report::{self, Endings, Subject},
    status::{Phase, Status, StatusSlot, StopToken},
};
use crate::{
    capture::{CaptureEnd, CaptureSummary, RecorderSummary},
    export::{ExportError, Report, ReportPictures},
};
use std::{any::Any, sync::Arc, thread::JoinHandle};

/// A running pipeline.
pub struct Handle {
    pub(super) subject: Subject,
    pub(super) watch: Watch,
    pub(super) threads: Threads,
    pub(super) drops: Arc<DropCounts>,
    pub(super) outbox: Arc<Outbox>,
    pub(super) folder: OutputFolder,
}

/// The threads of a pipeline, in the order in which they end; without a camera there is nothing to capture or record.
pub(super) struct Threads {
    pub device: Option<JoinHandle<CaptureSummary>>,
    pub fusion: JoinHandle<FusionSummary>,
    pub recorder: Option<JoinHandle<RecorderSummary>>,
    pub sewing: Option<JoinHandle<()>>,
    pub refine: JoinHandle<RefineSummary>,
}

/// Looks at a pipeline and stops it, from any thread.
#[derive(Clone, Debug, Default)]
pub struct Watch {
    pub(super) status: StatusSlot,
    /// Ends capture, so that the rest follows.
    pub(super) end: StopToken,
    /// Ends refinement too.
    pub(super) stop: StopToken,
    pub(super) live: Live,
    pub(super) events: EventLog,
    /// `None` where nothing is captured.
    pub(super) desk: Option<CommandDesk>,
}

impl Watch {
    /// The newest status.
    pub fn status(&self) -> Status {
        self.status.get()
    }

    /// What can be looked at beside the status.
    pub fn live(&self) -> &Live {
        &self.live
    }

    /// The newest events.
    pub fn events(&self) -> &EventLog {
        &self.events
    }

    /// Asks for something; it is done between two frames. Never blocks.
    ///
    /// # Errors
    /// If the command makes no sense now, or too many are waiting.
    pub fn command(&self, command: Command) -> Result<(), CommandRefused> {
        let desk = self.desk.as_ref().ok_or(CommandRefused::NotScanning)?;
        desk.ask(command, &self.status())?;
        match command {
            Command::Finish => self.end.stop(),
            Command::Abandon => self.stop(),
            _ => {}
        }
        Ok(())
    }

    /// Writes what belongs to the scan beside what the pipeline writes: where the disk is full the status tells of it, and it is tried
    /// again until there is room or somebody stops the pipeline. Blocks meanwhile.
    ///
    /// # Errors
    /// As `attempt`, if waiting helps nothing or somebody has stopped the pipeline.
    pub fn write_patiently<T>(
        &self,
        name: &str,
        attempt: impl Fn() -> Result<T, ExportError>,
    ) -> Result<T, ExportError> {
        Patience::new(&self.status, &self.stop).write(name, attempt)
    }

    /// Ends capture and refinement; what was fused is still exported and reported, but not improved.
    pub fn stop(&self) {
        self.stop.stop();
        self.end.stop();
    }
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// Everything that was asked for was tried.
    Complete,
    /// Somebody asked to stop.
    Stopped,
}

/// What a run leaves behind.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// How it ended.
    pub ending: Ending,
    /// The report, as it was written.
    pub report: Report,
    /// What went wrong, in sentences for the operator; empty after a good run.
    pub failures: Vec<String>,
    /// How many of these the disk may take later: it was full, read-only or away.
    pub n_passing: usize,
}

impl Outcome {
    /// Whether the run may go well another time, when the disk takes what it refused: nothing else went wrong.
    pub fn only_lacks_room(&self) -> bool {
        !self.failures.is_empty() && self.n_passing == self.failures.len()
    }
}

impl Handle {
    /// The newest status.
    pub fn status(&self) -> Status {
        self.watch.status()
    }

    /// Ends capture and refinement; what was fused is still exported and reported, but not improved.
    pub fn stop(&self) {
        self.watch.stop();
    }

    /// Something to look at the pipeline with while another thread waits in [`Handle::join`].
    pub fn watch(&self) -> Watch {
        self.watch.clone()
    }

    /// Waits for all threads, then writes the report.
    pub fn join(self) -> Outcome {
        let outbox = &self.outbox;
        let device = self.threads.device;
        let capture = device.and_then(|device| ended("device", device, outbox));
        let capture = capture.unwrap_or(CaptureSummary {
            n_frames: 0,
            n_damaged: 0,
            n_timeouts: 0,
            n_missed: 0,
            first_damage: None,
            end: CaptureEnd::Unwanted,
        });
        let fusion = ended("fusion", self.threads.fusion, outbox).unwrap_or_default();
        if let Some(recorder) = self.threads.recorder {
            ended("recorder", recorder, outbox);
        }
        if let Some(sewing) = self.threads.sewing {
            ended("sewing", sewing, outbox);
        }
        let refined =
            ended("refine", self.threads.refine, outbox).unwrap_or_else(|| RefineSummary {
                not_refined_reason: Some("refinement ended by a fault of the program".to_owned()),
                ..RefineSummary::default()
            });
        if let CaptureEnd::Failed(error) = &capture.end {
            outbox.fail(format!("the camera failed: {error}"));
        }
        let endings = Endings {
            capture: &capture,
            frames: &self.watch.status().frames,
            drops: &self.drops,
            fusion: &fusion,
            refined: &refined,
            stopped_early: self.watch.stop.is_stopped(),
        };
        self.watch
            .status
            .update(|status| status.phase = Phase::Exporting);
        conclude(&self.subject, &endings, outbox, self.folder)
    }
}

/// Writes the report, if there is anything to report, and frees the folder.
fn conclude(
    subject: &Subject,
    endings: &Endings,
    outbox: &Outbox,
    folder: OutputFolder,
) -> Outcome {
    let scan = endings.fusion.scan.as_ref();
    if scan.is_none() {
        outbox.fail(nothing_fused(subject, endings));
    }
    if let Some(reason) = &endings.fusion.no_surface_reason {
        outbox.fail(reason.clone());
    }
    let mut report = report::compose(subject, endings, &outbox.account());
    if let Some(scan) = scan {
        // Drawing takes as long as all else that a run has to do once it is stopped.
        let pictures = match endings.stopped_early {
            true => ReportPictures::default(),
            false => pictures_of(scan, endings.refined, outbox),
        };
        outbox.report(&mut report, &pictures);
    }
    drop(folder);
    let account = outbox.account();
    Outcome {
        ending: match endings.stopped_early {
            true => Ending::Stopped,
            false => Ending::Complete,
        },
        failures: account.failures,
        n_passing: account.n_passing,
        report,
    }
}

fn pictures_of(scan: &FusedScan, refined: &RefineSummary, outbox: &Outbox) -> ReportPictures {
    let draw = || pictures::draw(scan, refined);
    let drawn = std::panic::catch_unwind(std::panic::AssertUnwindSafe(draw));
    drawn.unwrap_or_else(|panic| {
        outbox.fail(fault("the report's pictures", panic.as_ref()));
        ReportPictures::default()
    })
}

fn nothing_fused(subject: &Subject, endings: &Endings) -> String {
    let frames = report::frame_counts(endings);
    let first = endings.capture.first_damage.as_ref();
    format!(
        "no frame of {} could be fused: {} frames, of which {} damaged, {} without depth in range, {} lost, {} dropped, \
         {} taken back{}",
        subject.session,
        frames.total,
        frames.damaged,
        frames.without_depth,
        frames.lost,
        frames.dropped,
        endings.fusion.n_taken_back,
        first.map_or_else(String::new, |what| format!("; the first damage: {what}"))
    )
}

/// What a thread returned; a panic is noted as a failure.
fn ended<T>(name: &str, thread: JoinHandle<T>, outbox: &Outbox) -> Option<T> {
    thread
        .join()
        .map_err(|panic| outbox.fail(fault(&format!("the {name} thread"), panic.as_ref())))
        .ok()
}

fn fault(what: &str, panic: &(dyn Any + Send)) -> String {
    let message = panic
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| panic.downcast_ref::<&str>().copied())
        .unwrap_or("no message");
    format!("{what} ended by a fault of the program: {message}")
}
