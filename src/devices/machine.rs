//! The machine that is looked at: this one, or the copy of another one's files.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// Where `/sys`, `/dev`, `/proc` and `/etc` are looked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Machine {
    root: PathBuf,
}

impl Machine {
    /// The machine that the program runs on.
    pub fn this() -> Self {
        Machine::under(Path::new("/"))
    }

    /// A machine whose file system lies in a folder.
    pub fn under(root: &Path) -> Self {
        Machine {
            root: root.to_owned(),
        }
    }

    /// Where a file of the machine is, by its absolute path there.
    pub(crate) fn path(&self, absolute: &str) -> PathBuf {
        self.root.join(absolute.trim_start_matches('/'))
    }

    /// The first line of a file, without the space around it; `None` if there is none that says something.
    pub(crate) fn line(&self, absolute: &str) -> Option<String> {
        line(&self.path(absolute))
    }
}

/// As [`Machine::line`], of a file that has been found.
pub(crate) fn line(path: &Path) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    let line = text.lines().next()?.trim();
    (!line.is_empty()).then(|| line.to_owned())
}
