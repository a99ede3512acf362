//! Recorded sessions behind [`depth_camera::DepthCamera`], and the writer of such recordings.
//!
//! A *session* is one folder: `session.toml` describes the camera, `depth.txt` and (where the camera delivers IR) `ir.txt`
//! list the images as `timestamp filename`, one a line, in the style of the TUM RGB-D benchmark, `#` starting a comment.
//! Images are 16-bit greyscale PNG: depth in `depth_units_per_metre`, 0 for no measurement; IR in raw counts. A *moment*
//! is what one call to `grab` delivers: a depth and an IR image at most 10 ms apart, or one of them alone.
//!
//! A session that makes no sense is refused as a whole by [`ReplayCamera::open`]; an image that does not decode costs its
//! own frame only. Nothing but the named lists, the images in them and a pose file named by the caller is ever opened.
//! Not handled: images in other formats, a depth grid that differs from the IR grid.
//!
//! Recordings of other kinds are kept in the same way: see [`read_list`], [`Pacer`], [`ListFile`] and [`write_whole_file`].

mod camera;
mod session;

mod content;
mod depth_scale;
mod files;
mod frame_check;
mod lists;
mod pacing;
mod poses;
mod repeat;
mod sixteen_bit_png;
mod writer;

pub use camera::ReplayCamera;
pub use content::{content_hash, hash_of_files};
pub use depth_scale::DepthScale;
pub use files::{
    ListFile, WriteError, create_empty_folder, create_folder, read_ordinary_file,
    read_ordinary_text, write_whole_file,
};
pub use frame_check::check_frame;
pub use lists::{Entry, Moment, SAME_MOMENT_SECS, merge_lists, read_list};
pub use pacing::{Pacer, Pacing};
pub use poses::{TimedPose, read_poses};
pub use repeat::{Open, RepeatingCamera};
pub use session::{FILE_NAME as SESSION_FILE_NAME, Images, SessionFile, unknown_keys};
pub use sixteen_bit_png::{
    PngEffort, any_of as any_of_sizes, decode as decode_png, read as read_png,
    read_one_of as read_png_of_size,
};
pub use writer::{SessionWriter, write_png};
