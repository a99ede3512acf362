//! How far a run is: a bar on a terminal, a line now and then elsewhere, or nothing.

use super::{progress_lines::ProgressLines, stderr::Stderr};
use crate::{
    lock::lock,
    pipeline::{Improvement, Phase, State, Status, Work},
};
use indicatif::{ProgressBar, ProgressStyle as BarStyle};
use std::{
    io::{self, IsTerminal, Write},
    sync::Mutex,
    time::{Duration, Instant},
};

/// How progress is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProgressStyle {
    /// A bar that is drawn over and over.
    Bar,
    /// A line every two seconds, and when the phase changes.
    Lines,
    /// How far refinement is, a JSON object a line on standard output, for the program that waits for it.
    JsonLines,
    /// Nothing.
    Silent,
}

impl ProgressStyle {
    /// What suits standard error.
    pub fn of_stderr() -> Self {
        match io::stderr().is_terminal() {
            true => ProgressStyle::Bar,
            false => ProgressStyle::Lines,
        }
    }
}

/// Lines are this far apart at least.
const BETWEEN_LINES: Duration = Duration::from_secs(2);

/// Shows how far a run is, on standard error, or on standard output for [`ProgressStyle::JsonLines`].
#[derive(Debug)]
pub struct Progress {
    style: ProgressStyle,
    bar: ProgressBar,
    last: Mutex<Option<(Instant, String)>>,
    json_lines: ProgressLines,
}

impl Progress {
    /// A display of that style, empty at first.
    pub fn new(style: ProgressStyle) -> Self {
        let bar = match style {
            ProgressStyle::Bar => ProgressBar::no_length(),
            ProgressStyle::Lines | ProgressStyle::JsonLines | ProgressStyle::Silent => {
                ProgressBar::hidden()
            }
        };
        Progress {
            style,
            bar,
            last: Mutex::default(),
            json_lines: ProgressLines::default(),
        }
    }

    /// Shows a status.
    pub fn show(&self, status: &Status) {
        match self.style {
            ProgressStyle::Bar => self.draw(status),
            ProgressStyle::Lines => self.print(status),
            ProgressStyle::JsonLines => self.json_lines.show(status),
            ProgressStyle::Silent => {}
        }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }

    /// A writer for log lines, which must not be drawn over.
    pub fn log_writer(&self) -> impl Fn() -> LogWriter + Send + Sync + 'static {
        let bar = self.bar.clone();
        move || LogWriter(bar.clone())
    }

    fn draw(&self, status: &Status) {
        let (done, of) = share(status);
        let template = match of {
            Some(_) => "{bar:32} {msg}",
            None => "{spinner} {msg}",
        };
        if let Ok(style) = BarStyle::with_template(template) {
            self.bar.set_style(style);
        }
        match of {
            Some(of) => self.bar.set_length(of),
            None => self.bar.tick(),
        }
        self.bar.set_position(done);
        self.bar.set_message(sentence(status));
    }

    fn print(&self, status: &Status) {
        let mut last = lock(&self.last);
        let line = sentence(status);
        let is_due = match &*last {
            None => status.frames.handled() > 0,
            Some((when, text)) => when.elapsed() >= BETWEEN_LINES && *text != line,
        };
        if is_due {
            let _ = writeln!(Stderr, "{line}");
            *last = Some((Instant::now(), line));
        }
    }
}

/// Writes log lines to standard error between two drawings of the bar.
#[derive(Debug)]
pub struct LogWriter(ProgressBar);

impl Write for LogWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.suspend(|| Stderr.write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        Stderr.flush()
    }
}

/// How much of the present phase is done, and of how much, where that is known.
fn share(status: &Status) -> (u64, Option<u64>) {
    match status.phase {
        Phase::Capturing => (
            status.frames.handled(),
            status.n_announced.map(|n| n as u64),
        ),
        Phase::Refining => {
            let (begun, of) = status.refinement.rounds;
            (begun as u64, Some(of.max(1) as u64))
        }
        Phase::Meshing => status.improvement.map_or((0, None), |improvement| {
            let (done, of) = (improvement.n_done, improvement.n_in_all);
            (done as u64, Some(of as u64))
        }),
        Phase::Exporting => (0, None),
    }
}

/// What the pipeline is doing, in one line.
fn sentence(status: &Status) -> String {
    if let (Phase::Capturing | Phase::Meshing, Some(improvement)) =
        (status.phase, status.improvement)
    {
        return improving(improvement);
    }
    match status.phase {
        Phase::Capturing => {
            let of = status
                .n_announced
                .map_or_else(String::new, |n| format!(" of {n}"));
            let frames = &status.frames;
            format!(
                "frame {}{of}: {} fused, {} lost{}, {} shading images",
                frames.handled(),
                frames.fused,
                frames.lost,
                state(status),
                status.snapshots.accepted
            )
        }
        Phase::Meshing => "extracting the base mesh".to_owned(),
        Phase::Refining if status.refinement.n_steps == 0 => "refining: preparing".to_owned(),
        Phase::Refining => format!(
            "refining: round {} of {}, step {}, energy at {:.1} % of the start",
            status.refinement.rounds.0,
            status.refinement.rounds.1,
            status.refinement.n_steps,
            100.0 * status.refinement.energy_share
        ),
        Phase::Exporting => "writing outputs".to_owned(),
    }
}

/// What is done to the scan as a whole.
fn improving(improvement: Improvement) -> String {
    let Improvement {
        work,
        n_done,
        n_in_all,
    } = improvement;
    let of = |what: &str| format!("{what} {n_done} of {n_in_all}");
    match work {
        Work::CorrectDepth(time) => of(&format!("correcting depth, pass {time}: frame")),
        Work::FuseFragments => of("closing loops: fragment"),
        Work::FindLoops => of("closing loops: looking for them from fragment"),
        Work::AlignFragments => of("closing loops: pair"),
        Work::CloseLoops => of("closing loops: frame"),
        Work::FuseWhole => of("completing the model: frame"),
        Work::SeparateThinParts => of("separating thin parts: frame"),
        Work::TakeBack => of("taking frames back: fusing again frame"),
    }
}

/// How tracking is doing: the reason where it is not at its best, the fitness where there is one.
fn state(status: &Status) -> String {
    let reason = status.state.reason().unwrap_or_default().replace('_', " ");
    match (status.state, status.fitness) {
        (State::Lost(_), _) => format!(", LOST ({reason})"),
        (State::Fault(_), _) => format!(", FAULT ({reason})"),
        (State::Relocalising, _) => ", looking for the place".to_owned(),
        (State::Paused, _) => ", paused".to_owned(),
        (State::Degraded(_), Some(fitness)) => format!(", fitness {fitness:.1} ({reason})"),
        (State::Degraded(_), None) => format!(" ({reason})"),
        (_, Some(fitness)) => format!(", fitness {fitness:.1}"),
        (_, None) => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{FrameAccounts, Loss, SnapshotCounts};

    #[test]
    fn a_status_reads_as_a_line() {
        let mut status = Status {
            n_announced: Some(48),
            frames: FrameAccounts {
                produced: 13,
                fused: 11,
                lost: 1,
                in_flight: 1,
                ..FrameAccounts::default()
            },
            fitness: Some(0.82),
            snapshots: SnapshotCounts {
                accepted: 3,
                ..SnapshotCounts::default()
            },
            ..Status::default()
        };
        assert_eq!(
            sentence(&status),
            "frame 12 of 48: 11 fused, 1 lost, fitness 0.8, 3 shading images"
        );
        assert_eq!(share(&status), (12, Some(48)));
        status.state = State::Lost(Loss::TooFast);
        assert_eq!(
            sentence(&status),
            "frame 12 of 48: 11 fused, 1 lost, LOST (too fast), 3 shading images"
        );
        status.phase = Phase::Meshing;
        status.improvement = Some(Work::CorrectDepth(2).at(30, 120));
        assert_eq!(
            sentence(&status),
            "correcting depth, pass 2: frame 30 of 120"
        );
        assert_eq!(share(&status), (30, Some(120)));
        status.phase = Phase::Refining;
        status.refinement.rounds = (2, 4);
        status.refinement.n_steps = 7;
        status.refinement.energy_share = 0.25;
        assert_eq!(
            sentence(&status),
            "refining: round 2 of 4, step 7, energy at 25.0 % of the start"
        );
    }
}
