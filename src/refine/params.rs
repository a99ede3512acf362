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
    /// Edge length of the refined mesh, metres; 0 for 0.8 of a pixel's footprint on the object, 1.3 mm at least.
    pub edge_length_m: f64,
    /// A larger object is remeshed more coarsely, so as to have about this many vertices.
    pub max_vertices: usize,
    /// Outer rounds, Eq. (9), before the last one.
    pub n_rounds: usize,
    /// Turns that the last round on each mesh takes at most until the surface rests; with 1 there is each round once.
    pub max_turns: usize,
    /// Accepted Levenberg–Marquardt steps a turn at most; on meshes coarser than the finest half as many again.
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
    /// Materials told apart by their albedo at most; with 1 nothing is refined where the images tell two.
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
            edge_length_m: 0.0,
            max_vertices: 250_000,
            n_rounds: 3,
            max_turns: 9,
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
            ("max_vertices", self.max_vertices as f64, 100.0, 5e6),
            ("n_rounds", self.n_rounds as f64, 1.0, 50.0),
            ("max_turns", self.max_turns as f64, 1.0, 50.0),
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
        let edge_length_m = self.edge_length_m;
        if edge_length_m != 0.0 && !(0.0003..=0.05).contains(&edge_length_m) {
            return Err(format!(
                "refine.edge_length_m is {edge_length_m}, must be 0 or 0.0003 to 0.05"
            ));
        }
        if self.jacobian == JacobianMode::Numeric && self.sites != SiteKind::Face {
            return Err("refine.jacobian is \"numeric\", which needs refine.sites \"face\"".into());
        }
        Ok(())
    }
}

/// Edges as shares of a pixel's footprint, and the shortest, metres, that are worth their time: at 1 mm for 1.3 a Kinect I's vases and
/// pots come out the same, at 1.8 mm for 1.3 a Kinect II's at 0.6 m 0.3° worse and at 0.8 m the same.
const EDGES_IN_PIXELS: f64 = 0.8;
const SHORTEST_EDGE_M: f64 = 0.0013;

impl RefineParams {
    /// The same with the edge length for an object on which a pixel covers `footprint_m` metres: as configured, or by that; longer where
    /// it would make too many vertices.
    pub fn for_object(&self, object: &TriMesh, footprint_m: f64) -> RefineParams {
        let edge_length_m = match self.edge_length_m {
            0.0 => (EDGES_IN_PIXELS * footprint_m).max(SHORTEST_EDGE_M),
            configured_m => configured_m,
        };
        // A vertex of an equilateral mesh has the area √3/2 h².
        let shortest_m = (object.area_m2() / (0.866 * self.max_vertices as f64)).sqrt();
        RefineParams {
            edge_length_m: edge_length_m.max(shortest_m),
            ..self.clone()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::scenes::RippledPlane;
    use super::*;

    #[test]
    fn edges_are_as_configured_or_by_the_footprint_and_make_no_more_vertices_than_allowed() {
        let object = RippledPlane { amplitude_m: 0.0 }.mesh(0.01);
        let edge_m = |edge_length_m: f64, footprint_m: f64, max_vertices: usize| {
            let params = RefineParams {
                edge_length_m,
                max_vertices,
                ..RefineParams::default()
            };
            params.validate().expect("in bounds");
            params.for_object(&object, footprint_m).edge_length_m
        };
        assert_eq!(edge_m(0.0, 0.003, 250_000), 0.8 * 0.003);
        assert_eq!(edge_m(0.0, 0.001, 250_000), SHORTEST_EDGE_M);
        assert_eq!(edge_m(0.0007, 0.003, 250_000), 0.0007);
        let few_m = edge_m(0.0007, 0.003, 100);
        let vertices = object.area_m2() / (0.866 * few_m * few_m);
        assert!((vertices - 100.0).abs() < 1e-6, "{vertices}");
        let negative = RefineParams {
            edge_length_m: -0.001,
            ..RefineParams::default()
        };
        assert_eq!(
            negative.validate().unwrap_err(),
            "refine.edge_length_m is -0.001, must be 0 or 0.0003 to 0.05"
        );
    }
}
