//! Hot-plugging on a mocked bus: events by umockdev's own library, through the sockets that the program listens on.
#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

mod testbed;

use std::time::Duration;

use testbed::{Testbed, run_mocked};
use udev_monitor::{Action, UsbMonitor};

/// Events come in order, as often as a device is plugged in and out.
fn hot_plug() {
    let testbed = Testbed::with_camera(0x02c4, "K7");
    let mut monitor = UsbMonitor::open().unwrap();
    assert_eq!(monitor.next(Duration::ZERO).unwrap(), None);
    for _ in 0..3 {
        for (told, action) in [("add", Action::Added), ("remove", Action::Removed)] {
            testbed.tell(told);
            let event = monitor.next(Duration::from_secs(10)).unwrap().unwrap();
            assert_eq!(event.action, action);
            assert_eq!(event.port, "1-1");
            assert_eq!(event.ids, Some((0x045e, 0x02c4)));
            assert_eq!(event.serial.as_deref(), Some("K7"));
        }
    }
    testbed.tell("change");
    assert_eq!(monitor.next(Duration::from_millis(50)).unwrap(), None);
}

#[test]
fn devices_that_come_and_go_are_told_of() {
    run_mocked("devices_that_come_and_go_are_told_of", hot_plug);
}

#[test]
fn a_machine_on_which_nothing_happens_tells_nothing() {
    let Ok(mut monitor) = UsbMonitor::open() else {
        eprintln!("skipped: a container may allow no such sockets");
        return;
    };
    assert_eq!(monitor.next(Duration::from_millis(1)).unwrap(), None);
}
