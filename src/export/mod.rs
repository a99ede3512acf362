//! What a scan leaves behind: meshes (PLY, GLB), the trajectory, the shading images, pictures, and the report; and what a
//! calibration leaves: its page.
//!
//! Every writer goes through [`write_atomically`]: a file stands under its final name whole or not at all. Lengths are
//! metres and the frame is `world` (the first camera: x right, y down, z forward; where poses are given, theirs), except that
//! the scene of a GLB is turned half about x, to glTF's y-up from y down, by its root node. Nothing here decides what is
//! exported or where; it is told by the pipeline.

mod atomic;
mod attributes;
mod error;
mod validate;

mod glb;
mod ply;
mod ply_header;
mod ply_reader;
mod trajectory;

mod material;
mod picture;
mod png;
mod snapshot_reader;
mod snapshots;
mod views;

mod chart;
mod evaluation;
mod page;
mod report;
mod report_format;
mod report_html;
mod report_refinement;
mod report_sections;
mod surface_field;

mod calibration_distance;
mod calibration_flat_field;
mod calibration_page;
mod calibration_response;
mod calibration_sections;
mod colour_scale;
mod scatter;

pub use crate::atomic_file::is_passing;
pub use atomic::write_atomically;
pub use attributes::VertexAttributes;
pub use calibration_page::{
    CalibrationPage, CalibrationResult, CalibrationSession, DistanceFigure, FlatFieldFigure,
    ResponseFigure, write_calibration_page,
};
pub use error::ExportError;
pub use evaluation::{
    Ablation, AblationOutcome, AgainstTruth, EvaluationPictures, EvaluationReport, LeftOutView,
    TruthFigures, write_evaluation,
};
pub use glb::write_glb;
pub use material::PhongParams;
pub use picture::phong;
pub use ply::write_ply;
pub use ply_reader::read_ply;
pub use png::{encode_png_grey8, encode_png_grey16, encode_png_rgb, encode_png_rgba};
pub use report::{
    AlbedoShare, BaseMesh, Evidence, FrameCounts, HeldOut, Iteration, LostSpan, REPORT_SCHEMA,
    RefinedMesh, RefinedView, Remeshing, Report, StageTiming, SurfaceDistance, ToldLight, Tracking,
    write_report_json,
};
pub use report_html::{ReportPictures, SurfaceField, write_report_html};
pub use snapshot_reader::{StoredSnapshot, StoredSnapshots, read_snapshots};
pub use snapshots::{SNAPSHOTS, SnapshotExport, SnapshotRecord, write_masks, write_snapshots};
pub use surface_field::SeenSurface;
pub use trajectory::{read_trajectory, tum_numbers, write_trajectory};
pub use views::{MeanView, PictureSize, PictureView, three_views};

#[cfg(test)]
mod tests;
