//! The report of a scan as data: what was captured, fused and refined, how well, and how long it took.
//!
//! The JSON file is one object: `"relief_report": 1`, which is the version of this schema, and the fields of [`Report`]. Units
//! are in the keys; a number that does not exist (0/0) is `null`. Fields may be added under the same version; it rises when
//! one is removed or changes its meaning.

use super::{ExportError, atomic::write_atomically};
use serde::Serialize;
use std::{io::Write, path::Path};

/// Version of the schema, the value of `relief_report`.
pub const REPORT_SCHEMA: u32 = 1;

/// All that a report says.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// Name of the recording or scan.
    pub session: String,
    /// Sensor by its name in `session.toml`.
    pub sensor: String,
    /// The device's serial number.
    pub serial: String,
    /// Version of the program.
    pub relief_version: String,
    /// Where the calibration of the IR image comes from.
    pub calibration: String,
    /// Whether the run was stopped before its end.
    pub stopped_early: bool,
    /// What became of the frames.
    pub frames: FrameCounts,
    /// What became of the camera's path.
    pub tracking: Tracking,
    /// The fused mesh.
    pub base_mesh: BaseMesh,
    /// The refined mesh, if there is one.
    pub refined_mesh: Option<RefinedMesh>,
    /// Why there is no refined mesh, in a sentence for the operator.
    pub not_refined_reason: Option<String>,
    /// Sentences for the operator.
    pub warnings: Vec<String>,
    /// Time spent, in the order of the pipeline.
    pub timings: Vec<StageTiming>,
    /// Largest resident memory of the process, bytes; `None` where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
    /// Paths of all files written.
    pub outputs: Vec<String>,
}

/// What became of the frames of a scan.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FrameCounts {
    /// Frames that the device delivered, damaged ones too.
    pub total: u64,
    /// Frames that were fused, those that were taken back later, too.
    pub fused: u64,
    /// Frames in the model at the end.
    pub in_model: u64,
    /// Frames during which tracking was lost.
    pub lost: u64,
    /// Frames that came damaged.
    pub damaged: u64,
    /// Frames dropped because the program was busy.
    pub dropped: u64,
    /// Frames that carry no depth, such as shading images.
    pub without_depth: u64,
    /// Frames that came while the scan was paused.
    pub paused: u64,
    /// Frames that none of the above accounts for: 0 unless the program is wrong.
    pub unaccounted: i64,
    /// Frames, and infrared images that frames lack, which the driver had and let go: not among the total.
    pub missed: u64,
}

/// What became of the camera's path.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Tracking {
    /// Length of the camera's path, metres.
    pub path_length_m: f64,
    /// How often a lost camera was found in another place than it was lost at.
    pub n_relocalised: u64,
    /// Frames fused at their given pose although it was to be polished: none near it was believed.
    pub n_unpolished: u64,
    /// When the camera was lost.
    pub lost_spans: Vec<LostSpan>,
}

/// A time during which tracking was lost.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LostSpan {
    /// First frame without a pose.
    pub first_frame_id: u64,
    /// Last frame without a pose.
    pub last_frame_id: u64,
    /// Device time of the first, seconds.
    pub start_secs: f64,
    /// Device time of the last, seconds.
    pub end_secs: f64,
    /// Why it was lost.
    pub reason: String,
}

/// The fused mesh.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct BaseMesh {
    /// Vertices.
    pub vertices: usize,
    /// Faces.
    pub faces: usize,
    /// Surface area, m².
    pub area_m2: f64,
    /// Holes that were filled; 0 unless that was asked for.
    pub n_holes_filled: usize,
    /// Area of what fills them, m².
    pub filled_m2: f64,
    /// File.
    pub path: String,
}

/// The refined mesh and how it came about.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RefinedMesh {
    /// Vertices.
    pub vertices: usize,
    /// Faces.
    pub faces: usize,
    /// Surface area, m².
    pub area_m2: f64,
    /// File.
    pub path: String,
    /// How refinement ended: `converged`, `iteration limit`, `stalled`, `cancelled`, `singular`.
    pub status: String,
    /// The outer iterations.
    pub iterations: Vec<Iteration>,
    /// Mean length of an edge, metres.
    pub edge_length_m: f64,
    /// How far remeshing moved the surface before anything was displaced.
    pub remeshing: Remeshing,
    /// The materials found, in the order of their labels, from dark to bright.
    pub albedo: Vec<AlbedoShare>,
    /// Gloss of the glossiest of them.
    pub gloss: f64,
    /// Difference of rendered and observed IR over all views on the base mesh, root mean square, share of the mean observed
    /// linear intensity.
    pub rmse_before: f64,
    /// The same on the refined mesh.
    pub rmse_after: f64,
    /// How much patches of the base surface disagree with what the light makes of them, in standard deviations: 1 on most scans; 0 where they
    /// were not asked.
    pub misfit: f64,
    /// What the images say of response and light, where that is not what the calibration says: the mesh is refined by it.
    pub told: Option<ToldLight>,
    /// What images that refinement did not use say of both meshes.
    pub held_out: HeldOut,
    /// What the images say of the vertices.
    pub evidence: Evidence,
    /// The shading images.
    pub views: Vec<RefinedView>,
}

/// Response and light as the images have them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ToldLight {
    /// Exponent of the response.
    pub gamma: f64,
    /// That of the calibration.
    pub believed_gamma: f64,
    /// The light's place in the IR camera's frame, metres, where it is told.
    pub light_position_m: Option<[f64; 3]>,
    /// How far that is, across the optical axis, from where it was believed, metres.
    pub light_moved_m: f64,
    /// Exponent of the emission's cosine about the optical axis.
    pub lobe_power: f64,
    /// That of the calibration.
    pub believed_lobe_power: f64,
    /// The white level of the calibration by that gamma, if it has one.
    pub white_level: Option<f64>,
}

/// How far the remeshed surface, not displaced yet, and the part of the base mesh that is refined lie apart. Of more than 20 000 points
/// every n-th is asked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Remeshing {
    /// Hausdorff distance over these points: the larger of the largest, metres.
    pub hausdorff_m: f64,
    /// From vertices of the base mesh to the remeshed surface.
    pub from_base: SurfaceDistance,
    /// From middles of the remeshed surface's faces to the base mesh.
    pub from_remeshed: SurfaceDistance,
}

/// How far points of one surface lie from another.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SurfaceDistance {
    /// Points that were asked.
    pub n_points: usize,
    /// The largest, metres.
    pub max_m: f64,
    /// Root mean square, metres.
    pub rms_m: f64,
}

/// What the images say of the vertices of a refined mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Evidence {
    /// Share of the vertices that no image shows: there the surface is as it was fused, but for some 8 mm beside what images show.
    pub unseen_share: f64,
    /// Share of the vertices that images show, but not from where their tilt would change the brightness.
    pub weak_share: f64,
    /// Images that show a vertex, median.
    pub median_views: usize,
    /// Standard deviation of the displacement, median, metres.
    pub median_sigma_m: f64,
    /// Nine tenths of the vertices have no larger one, metres.
    pub high_sigma_m: f64,
}

/// Images held out from refinement against what is rendered from either mesh, integrated over pixels: root mean squares as
/// shares of the mean observed linear intensity. Where none judged, the figures are NaN.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct HeldOut {
    /// How many were held out; none if there was a single one.
    pub n_views: usize,
    /// Error of the intensity, base mesh.
    pub intensity_base: f64,
    /// Refined mesh, before the last round took in the images held out.
    pub intensity_refined: f64,
    /// What the sensor's noise would leave.
    pub intensity_noise: f64,
    /// Error of the intensity's gradient per pixel, base mesh.
    pub gradient_base: f64,
    /// Refined mesh.
    pub gradient_refined: f64,
    /// What the sensor's noise would leave.
    pub gradient_noise: f64,
    /// Root mean square of the gains, less 1, that took up slow differences of brightness.
    pub slow_gain: f64,
}

/// One outer iteration of refinement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Iteration {
    /// Robust energy before the step.
    pub energy_before: f64,
    /// Robust energy after the step.
    pub energy_after: f64,
    /// Largest displacement of a vertex, metres.
    pub max_step_m: f64,
    /// Levenberg–Marquardt damping.
    pub damping: f64,
}

/// A material of the surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct AlbedoShare {
    /// Its albedo.
    pub albedo: f64,
    /// Its share of the surface, 0 to 1.
    pub area_share: f64,
    /// Brightness at the middle of the gloss that the images show, in albedos; 0 where it is taken for matte.
    pub gloss: f64,
}

/// One shading image in refinement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct RefinedView {
    /// The frame.
    pub frame_id: u64,
    /// Device time, seconds.
    pub time_secs: f64,
    /// Brightness of the view against the common model.
    pub gain: f64,
    /// Its pose as refined by the images, world from camera: translation in metres, then the quaternion x, y, z, w.
    pub world_from_camera: [f64; 7],
    /// Shift of the image found by alignment, pixels (u, v).
    pub shift_px: [f64; 2],
    /// Difference of rendered and observed IR on the base mesh, root mean square, share of the mean observed
    /// linear intensity.
    pub rmse_before: f64,
    /// The same on the refined mesh.
    pub rmse_after: f64,
    /// Sites of the surface that the view sees.
    pub n_sites: usize,
}

/// Time spent in one stage.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StageTiming {
    /// The stage.
    pub name: String,
    /// All together, seconds.
    pub total_secs: f64,
    /// How often it ran.
    pub n: u64,
    /// Median of one run, milliseconds.
    pub median_ms: f64,
}

/// A report behind its version.
#[derive(Serialize)]
struct Versioned<'a> {
    relief_report: u32,
    #[serde(flatten)]
    report: &'a Report,
}

/// Writes a report as JSON, indented.
///
/// # Errors
/// [`ExportError::Write`] if the file cannot be written.
pub fn write_report_json(path: &Path, report: &Report) -> Result<(), ExportError> {
    let versioned = Versioned {
        relief_report: REPORT_SCHEMA,
        report,
    };
    write_atomically(path, |file| {
        serde_json::to_writer_pretty(&mut *file, &versioned)?;
        file.write_all(b"\n")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;

    #[test]
    fn the_file_states_its_version_and_null_where_there_is_no_number() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report.json");
        let report = Report {
            session: "pot".into(),
            refined_mesh: Some(RefinedMesh {
                rmse_before: f64::NAN,
                rmse_after: 0.02,
                ..RefinedMesh::default()
            }),
            ..Report::default()
        };
        write_report_json(&path, &report).unwrap();
        let back: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        assert_eq!(back["relief_report"], Value::from(REPORT_SCHEMA));
        assert_eq!(back["session"], Value::from("pot"));
        assert_eq!(back["refined_mesh"]["rmse_before"], Value::Null);
        assert_eq!(back["refined_mesh"]["rmse_after"], Value::from(0.02));
        assert_eq!(back["not_refined_reason"], Value::Null);
    }
}
