//! The files of a recording that is being written: there whole, or not at all.

use std::{
    fs::{self, File, OpenOptions},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
};

use depth_camera::CameraError;

/// Why a recording could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The system refused: no space, no permission, no such folder.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder that could not be written.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The folder holds something already.
    #[error("{} is not empty, a recording goes into a new or an empty folder", .0.display())]
    NotEmpty(PathBuf),
    /// The camera's description would not be read again.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A frame that does not belong into this recording; nothing of it was written.
    #[error("frame {frame_id} cannot be recorded: {reason}")]
    Frame {
        /// The frame that was refused.
        frame_id: u64,
        /// What is wrong with it.
        reason: String,
    },
}

/// A file of a recording is at most so long, bytes: the largest image that is worked on has 16 MiB.
const MAX_READ_BYTES: u64 = 64 << 20;

/// Reads a whole file of a recording. What is no ordinary file may never end, and is refused.
///
/// # Errors
/// What the system says, or what is wrong with the file.
pub fn read_ordinary_file(path: &Path) -> io::Result<Vec<u8>> {
    let metadata = fs::metadata(path)?;
    if !metadata.is_file() {
        return Err(io::Error::other("no ordinary file"));
    }
    let n_bytes = metadata.len();
    if n_bytes > MAX_READ_BYTES {
        return Err(io::Error::other(format!(
            "{n_bytes} bytes, must be at most {MAX_READ_BYTES}"
        )));
    }
    fs::read(path)
}

/// As [`read_ordinary_file`], a text.
///
/// # Errors
/// As [`read_ordinary_file`], and for bytes that are no UTF-8.
pub fn read_ordinary_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read_ordinary_file(path)?).map_err(io::Error::other)
}

/// A list that only ever grows by whole lines.
#[derive(Debug)]
pub struct ListFile {
    path: PathBuf,
    file: File,
    length: u64,
}

impl ListFile {
    /// A new list at `path`, empty but for its heading.
    ///
    /// # Errors
    /// [`WriteError::Io`], also for a file that is there already.
    pub fn create(path: PathBuf) -> Result<Self, WriteError> {
        let file = OpenOptions::new()
            .append(true)
            .create_new(true)
            .open(&path)
            .map_err(io_error(&path))?;
        let mut list = ListFile {
            path,
            file,
            length: 0,
        };
        list.append_line("# timestamp filename\n")?;
        Ok(list)
    }

    /// Appends a line, whole or not at all.
    ///
    /// # Errors
    /// [`WriteError::Io`].
    pub fn append(&mut self, time_secs: f64, file_name: &str) -> Result<(), WriteError> {
        self.append_line(&format!("{time_secs:.6} {file_name}\n"))
    }

    /// Hands the list to the disk.
    ///
    /// # Errors
    /// [`WriteError::Io`].
    pub fn sync(&self) -> Result<(), WriteError> {
        self.file.sync_all().map_err(io_error(&self.path))
    }

    /// Takes back what was written of a line that did not fit on the disk.
    fn append_line(&mut self, line: &str) -> Result<(), WriteError> {
        if let Err(source) = self.file.write_all(line.as_bytes()) {
            // Shortening needs no space; if even that fails, the first error is the one to report.
            let _ = self.file.set_len(self.length);
            return Err(io_error(&self.path)(source));
        }
        self.length += line.len() as u64;
        Ok(())
    }
}

/// Makes a folder that must not hold anything yet.
///
/// # Errors
/// [`WriteError::NotEmpty`], [`WriteError::Io`].
pub fn create_empty_folder(folder: &Path) -> Result<(), WriteError> {
    create_folder(folder)?;
    let mut entries = fs::read_dir(folder).map_err(io_error(folder))?;
    match entries.next() {
        Some(_) => Err(WriteError::NotEmpty(folder.to_owned())),
        None => Ok(()),
    }
}

/// Makes a folder, and those that it lies in.
///
/// # Errors
/// [`WriteError::Io`].
pub fn create_folder(folder: &Path) -> Result<(), WriteError> {
    fs::create_dir_all(folder).map_err(io_error(folder))
}

/// Writes a file under a temporary name and renames it, so that it is there whole or not at all.
///
/// # Errors
/// [`WriteError::Io`].
pub fn write_whole_file(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), WriteError> {
    let partial = path.with_extension("partial");
    let result = File::create(&partial).and_then(|file| {
        let mut out = BufWriter::new(file);
        write(&mut out)?;
        out.flush()?;
        fs::rename(&partial, path)
    });
    if result.is_err() {
        // What is left of it is of no use; the error to report is the first one.
        let _ = fs::remove_file(&partial);
    }
    result.map_err(io_error(path))
}

fn io_error(path: &Path) -> impl Fn(io::Error) -> WriteError + '_ {
    move |source| WriteError::Io {
        path: path.to_owned(),
        source,
    }
}
