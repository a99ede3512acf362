//! What refinement needs to know, and the bounds of it.

use super::albedo::AlbedoParams;
use super::alignment::AlignmentParams;
use super::numeric::JacobianMode;
use super::self_calibration::SelfCalibrationParams;
use super::site_motion::Linearisation;
use super::sites::SiteKind;
use super::view::ImageTrust;
use crate::geometry::TriMesh;
use serde::{Deserialize, Serialize};

/// What refinement needs to know.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefineParams {
    /// Edge length of the refined mesh, metres; about the footprint of a pixel.
    pub edge_length_m: f64,
    /// A larger object is remeshed more coarsely, so as to have about this many vertices.
    pub max_vertices: usize,
    /// Outer rounds, Eq. (9), before the last one.
    pub n_rounds: usize,
    /// Accepted Levenberg–Marquardt steps a round at most; on meshes coarser than the finest half as many again.
    pub max_steps: usize,
    /// Size of the patches whose mean displacement the depth sensor holds, metres: Eq. (8).
    pub patch_m: f64,
    /// Standard deviation of a patch's mean displacement, metres. The residuals of a site go together over views and
    /// neighbours, which makes the data term some twenty-five times too sure; the value is in those units, some two fifths of
    /// the fused surface's slow error. 0.05 mm loses detail; 0.3 mm is as good on the recorded scans, 10 mm holds nothing.
    pub patch_sigma_m: f64,
    /// Standard deviation of the slope of the displacement, radians: Eq. (7). 0.15 and 0.3 give the same surface.
    pub slope_sigma_rad: f64,
    /// Where the surface is compared with the images: for displacements, albedo, poses and gains.
    pub sites: SiteKind,
    /// What of the data term follows the displacements within a round.
    pub linearisation: Linearisation,
    /// Whether the last round takes off what pixels mix of the surface beside each site; sharpening by the blur's variance
    /// is right to second order alone.
    pub integrate_pixels: bool,
    /// How the derivatives of the data term are found; both ways give the same surface.
    pub jacobian: JacobianMode,
    /// Materials told apart by their albedo at most.
    pub max_albedos: usize,
    /// Whether light that arrives over other surfaces is predicted beside that of Eq. (1).
    pub interreflection: bool,
    /// How they are told apart.
    pub albedo: AlbedoParams,
    /// How far Eq. (1) is believed.
    pub trust: ImageTrust,
    /// Alignment of the views.
    pub alignment: AlignmentParams,
    /// Response and light by the images, where they contradict the calibration.
    pub self_calibration: SelfCalibrationParams,
}

impl Default for RefineParams {
    fn default() -> Self {
        RefineParams {
            edge_length_m: 0.0013,
            max_vertices: 250_000,
            n_rounds: 3,
            max_steps: 2,
            patch_m: 0.02,
            patch_sigma_m: 0.00018,
            slope_sigma_rad: 0.15,
            sites: SiteKind::Vertex,
            linearisation: Linearisation::Full,
            integrate_pixels: true,
            jacobian: JacobianMode::Analytic,
            max_albedos: 6,
            interreflection: true,
            albedo: AlbedoParams::default(),
            trust: ImageTrust::default(),
            alignment: AlignmentParams::default(),
            self_calibration: SelfCalibrationParams::default(),
        }
    }
}

impl RefineParams {
    /// Checks every value against its bound.
    ///
    /// # Errors
    /// Names the key, its value and the bound.
    pub fn validate(&self) -> Result<(), String> {
        for (key, value, low, high) in [
            ("edge_length_m", self.edge_length_m, 0.0003, 0.05),
            ("max_vertices", self.max_vertices as f64, 100.0, 5e6),
            ("n_rounds", self.n_rounds as f64, 1.0, 50.0),
            ("max_steps", self.max_steps as f64, 1.0, 50.0),
            ("patch_sigma_m", self.patch_sigma_m, 1e-6, 0.1),
            ("slope_sigma_rad", self.slope_sigma_rad, 1e-4, 2.0),
            ("patch_m", self.patch_m, 1e-3, 1.0),
            ("max_albedos", self.max_albedos as f64, 1.0, 8.0),
            ("trust.max_slow_gain", self.trust.max_slow_gain, 0.0, 10.0),
            ("trust.model_error", self.trust.model_error, 0.0, 1.0),
            (
                "trust.misregistration_px",
                self.trust.misregistration_px,
                0.0,
                10.0,
            ),
            ("trust.gain_cell_m", self.trust.gain_cell_m, 1e-3, 10.0),
            (
                "alignment.rotation_sigma_rad",
                self.alignment.rotation_sigma_rad,
                1e-6,
                1.0,
            ),
            (
                "alignment.translation_sigma_m",
                self.alignment.translation_sigma_m,
                1e-6,
                1.0,
            ),
            ("alignment.gain_sigma", self.alignment.gain_sigma, 1e-6, 1.0),
            (
                "alignment.correlation_m",
                self.alignment.correlation_m,
                1e-4,
                10.0,
            ),
            (
                "alignment.iterations",
                self.alignment.iterations as f64,
                0.0,
                100.0,
            ),
            (
                "self_calibration.gamma_sigma",
                self.self_calibration.gamma_sigma,
                1e-6,
                10.0,
            ),
            (
                "self_calibration.light_sigma_m",
                self.self_calibration.light_sigma_m,
                1e-6,
                1.0,
            ),
            (
                "self_calibration.lobe_sigma",
                self.self_calibration.lobe_sigma,
                1e-6,
                10.0,
            ),
        ] {
            if !(value >= low && value <= high) {
                return Err(format!("refine.{key} is {value}, must be {low} to {high}"));
            }
        }
        if self.jacobian == JacobianMode::Numeric && self.sites != SiteKind::Face {
            return Err("refine.jacobian is \"numeric\", which needs refine.sites \"face\"".into());
        }
        Ok(())
    }
}

impl RefineParams {
    /// The same with the edge length for an object: as configured, or longer where that would make too many vertices.
    pub fn for_object(&self, object: &TriMesh) -> RefineParams {
        // A vertex of an equilateral mesh has the area √3/2 h².
        let shortest_m = (object.area_m2() / (0.866 * self.max_vertices as f64)).sqrt();
        RefineParams {
            edge_length_m: self.edge_length_m.max(shortest_m),
            ..self.clone()
        }
    }
}
