//! What the operator asks of a scan that goes on, and why it may be refused.

use super::status::{Phase, Status};
use crate::lock::lock;
use crossbeam::channel::{Sender, TrySendError};
use std::sync::{Arc, Mutex};

/// What the operator asks of a running pipeline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Command {
    /// Frames are counted and not used until [`Command::Resume`].
    Pause,
    /// Ends a pause; tracking looks for the camera in the same model.
    Resume,
    /// The next frame that passes the gates of quality becomes a shading image, however little it adds.
    Snapshot,
    /// Takes back what was fused during the last seconds of tracking.
    Undo {
        /// Seconds of the device's clock.
        secs: f64,
    },
    /// Writes what there is into a folder of its own, to be refined while the scan goes on.
    Refine,
    /// Forgets model, path and shading images and begins anew.
    Reset,
    /// Ends capture; base mesh, shading images and report are written, and refinement runs if it was asked for.
    Finish,
    /// Ends capture, all that improves the scan at its end, and all refinement; base mesh, shading images and report are still
    /// written, if the disk has room now. Taken while the scan ends, too.
    Abandon,
}

/// Seconds that can be taken back at most.
const MAX_UNDO_SECS: f64 = 3600.0;

/// Why a command was not taken.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CommandRefused {
    /// Nothing is captured.
    #[error("no scan is going on")]
    NotScanning,
    /// Capture has ended, or is to.
    #[error("the scan is ending; it can only be abandoned")]
    Ending,
    /// It is paused.
    #[error("the scan is paused already")]
    AlreadyPaused,
    /// It is not paused.
    #[error("the scan is not paused")]
    NotPaused,
    /// While paused no frame can become a shading image.
    #[error("the scan is paused; resume it first")]
    Paused,
    /// A shading image is awaited.
    #[error("a shading image is being taken already")]
    AlreadySnapshotting,
    /// There are no infrared images to shade with.
    #[error("the camera gives no shading images")]
    NoShadingImages,
    /// Nothing has been fused.
    #[error("nothing has been fused yet")]
    NothingFused,
    /// A time that makes no sense.
    #[error("secs is {secs}, must be above 0 and at most {MAX_UNDO_SECS}")]
    BadUndo {
        /// What was asked.
        secs: f64,
    },
    /// Earlier commands have not been handled yet.
    #[error("too many commands are waiting")]
    Busy,
}

impl CommandRefused {
    /// The reason's stable name.
    pub fn code(&self) -> &'static str {
        match self {
            CommandRefused::NotScanning => "not_scanning",
            CommandRefused::Ending => "ending",
            CommandRefused::AlreadyPaused => "already_paused",
            CommandRefused::NotPaused => "not_paused",
            CommandRefused::Paused => "paused",
            CommandRefused::AlreadySnapshotting => "already_snapshotting",
            CommandRefused::NoShadingImages => "no_shading_images",
            CommandRefused::NothingFused => "nothing_fused",
            CommandRefused::BadUndo { .. } => "bad_undo",
            CommandRefused::Busy => "busy",
        }
    }
}

/// Where commands are asked for. Whether one makes sense is decided here, by what was asked before, so that two in a row
/// need not wait for the first to be handled.
#[derive(Clone, Debug)]
pub struct CommandDesk {
    asked: Arc<Mutex<Asked>>,
    channel: Sender<Command>,
}

/// What the commands so far amount to.
#[derive(Clone, Copy, Debug, Default)]
struct Asked {
    is_paused: bool,
    is_ending: bool,
}

impl CommandDesk {
    /// A desk that hands commands to a channel.
    pub fn new(channel: Sender<Command>) -> Self {
        CommandDesk {
            asked: Arc::default(),
            channel,
        }
    }

    /// Takes a command, or says why not; never blocks.
    pub fn ask(&self, command: Command, status: &Status) -> Result<(), CommandRefused> {
        let mut asked = lock(&self.asked);
        if asked.is_ending || status.phase != Phase::Capturing {
            return while_ending(command);
        }
        let next = asked.after(command, status)?;
        match self.channel.try_send(command) {
            Ok(()) => {}
            // The device thread ends the stream: who obeys has nothing to do for it.
            Err(TrySendError::Full(_)) if next.is_ending => {}
            Err(TrySendError::Full(_)) => return Err(CommandRefused::Busy),
            Err(TrySendError::Disconnected(_)) => return while_ending(command),
        }
        *asked = next;
        Ok(())
    }
}

/// Who obeys commands may be gone, or busy with the end for as long as the scan took: what is left to ask for needs nobody.
fn while_ending(command: Command) -> Result<(), CommandRefused> {
    match command {
        Command::Abandon => Ok(()),
        _ => Err(CommandRefused::Ending),
    }
}

impl Asked {
    /// What the commands of a scan that is captured amount to after one more.
    fn after(self, command: Command, status: &Status) -> Result<Self, CommandRefused> {
        let has_fused = status.n_in_model > 0;
        let refused = match command {
            Command::Pause if self.is_paused => Some(CommandRefused::AlreadyPaused),
            Command::Resume if !self.is_paused => Some(CommandRefused::NotPaused),
            Command::Snapshot if self.is_paused => Some(CommandRefused::Paused),
            Command::Snapshot if status.snapshots.wanted == 0 => {
                Some(CommandRefused::NoShadingImages)
            }
            Command::Snapshot if status.is_snapshotting => {
                Some(CommandRefused::AlreadySnapshotting)
            }
            Command::Undo { secs } if !(secs > 0.0 && secs <= MAX_UNDO_SECS) => {
                Some(CommandRefused::BadUndo { secs })
            }
            Command::Undo { .. } | Command::Refine if !has_fused => {
                Some(CommandRefused::NothingFused)
            }
            _ => None,
        };
        match refused {
            Some(refused) => Err(refused),
            None => Ok(Asked {
                is_paused: match command {
                    Command::Pause => true,
                    Command::Resume => false,
                    _ => self.is_paused,
                },
                is_ending: matches!(command, Command::Finish | Command::Abandon),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{edges, handle::Watch};

    #[test]
    fn a_scan_that_is_ending_can_be_abandoned_in_every_phase_and_nothing_else() {
        for phase in [
            Phase::Capturing,
            Phase::Meshing,
            Phase::Refining,
            Phase::Exporting,
        ] {
            // Nobody takes commands out, as while loops are closed.
            let (channel, _commands) = edges::commands();
            let watch = Watch {
                desk: Some(CommandDesk::new(channel)),
                ..Watch::default()
            };
            watch.command(Command::Finish).unwrap();
            watch.status.update(|status| status.phase = phase);
            for refused in [Command::Pause, Command::Refine, Command::Finish] {
                assert_eq!(watch.command(refused), Err(CommandRefused::Ending));
            }
            assert!(watch.end.is_stopped() && !watch.stop.is_stopped());
            // It may be asked for again: it is as it was.
            for _ in 0..2 {
                watch.command(Command::Abandon).unwrap();
            }
            assert!(watch.stop.is_stopped(), "{phase:?}");
        }
    }

    #[test]
    fn a_scan_ends_however_many_commands_wait() {
        for ending in [Command::Finish, Command::Abandon] {
            // Nobody takes commands out, as while frames are taken back.
            let (channel, commands) = edges::commands();
            let desk = CommandDesk::new(channel);
            let status = Status::default();
            while desk.ask(Command::Reset, &status).is_ok() {}
            let refused = desk.ask(Command::Reset, &status);
            assert_eq!(refused, Err(CommandRefused::Busy));
            assert_eq!(desk.ask(ending, &status), Ok(()));
            let refused = desk.ask(Command::Reset, &status);
            assert_eq!(refused, Err(CommandRefused::Ending));
            assert!(commands.try_iter().all(|command| command == Command::Reset));
        }
    }

    #[test]
    fn a_scan_whose_fusion_is_gone_can_be_abandoned() {
        let (channel, commands) = edges::commands();
        drop(commands);
        let desk = CommandDesk::new(channel);
        let status = Status::default();
        assert_eq!(desk.ask(Command::Abandon, &status), Ok(()));
        let refused = desk.ask(Command::Finish, &status);
        assert_eq!(refused, Err(CommandRefused::Ending));
    }
}
