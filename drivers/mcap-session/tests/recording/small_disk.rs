//! A small disk of its own, where this user may mount one.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// A disk in memory, mounted until it is dropped.
pub struct SmallDisk(pub PathBuf);

impl SmallDisk {
    /// Mounts a disk of so many megabytes; `None`, which is said, where this user cannot.
    pub fn mount(at: &Path, megabytes: u32) -> Option<Self> {
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &format!("size={megabytes}m"), "tmpfs"])
            .arg(at)
            .output();
        match mounted {
            Ok(output) if output.status.success() => Some(SmallDisk(at.to_owned())),
            _ => {
                println!("skipped: this user cannot mount a disk");
                None
            }
        }
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}
