//! What udev says of Kinects that are plugged in, which is a reason to look for the one that has gone.

use std::{
    thread,
    time::{Duration, Instant},
};

use udev_monitor::{Action, UsbEvent, UsbMonitor};

/// Microsoft, as a USB vendor.
const VENDOR: u16 = 0x045e;

/// Who tells of them, if anybody does.
#[derive(Debug, Default)]
pub(crate) struct Announcements {
    monitor: Option<UsbMonitor>,
}

impl Announcements {
    pub(crate) fn listen_to(&mut self, monitor: UsbMonitor) {
        self.monitor = Some(monitor);
    }

    /// Waits at most `timeout`; whether what may be a part of a Kinect was plugged in meanwhile, or since the last call.
    ///
    /// Serial numbers are not compared: that of a later model is its audio part's, and each part is announced by itself.
    pub(crate) fn wait(&mut self, timeout: Duration) -> bool {
        let deadline = Instant::now() + timeout;
        let mut is_announced = false;
        while let Some(monitor) = &mut self.monitor {
            let remaining = match is_announced {
                true => Duration::ZERO,
                false => deadline.saturating_duration_since(Instant::now()),
            };
            match monitor.next(remaining) {
                Ok(Some(event)) => is_announced |= may_be_kinect(&event),
                Ok(None) => return is_announced,
                // What nobody tells of is found by looking.
                Err(_) => self.monitor = None,
            }
        }
        thread::sleep(deadline.saturating_duration_since(Instant::now()));
        is_announced
    }
}

fn may_be_kinect(event: &UsbEvent) -> bool {
    event.action == Action::Added && event.ids.is_none_or(|(vendor, _)| vendor == VENDOR)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_from_the_vendor_or_from_who_knows_whom_may_be_a_kinect() {
        let event = |action, ids| UsbEvent {
            action,
            port: "1-1".to_owned(),
            ids,
            serial: None,
        };
        assert!(may_be_kinect(&event(Action::Added, Some((VENDOR, 0x02ae)))));
        assert!(may_be_kinect(&event(Action::Added, None)));
        assert!(!may_be_kinect(&event(
            Action::Added,
            Some((0x046d, 0x02ae))
        )));
        assert!(!may_be_kinect(&event(
            Action::Removed,
            Some((VENDOR, 0x02ae))
        )));
    }
}
