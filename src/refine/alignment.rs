//! Pose and gain of each view, from the images: Gauss-Newton on the shading residuals of all sites that the view sees, with
//! a prior from the tracker, in turn with the displacements.
//!
//! A view's parameters are a turn about the object's centre, a shift, and the logarithm of its gain. About that centre a turn
//! and a shift move pixels in different ways, so that both are determined.

use super::gaze::Gaze;
use super::sites::Sites;
use super::view::{Sample, View};
use crate::geometry::{Pose, increment_about, increment_of};
use crate::robust::Tukey;
use nalgebra::{Matrix6, Point3, SMatrix, SVector, Vector6};
use serde::{Deserialize, Serialize};

/// How far the images may take a view from where the tracker put it.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct AlignmentParams {
    /// Standard deviation of the tracker's orientation, radians.
    pub rotation_sigma_rad: f64,
    /// Standard deviation of the tracker's position of the object, metres.
    pub translation_sigma_m: f64,
    /// Standard deviation of a view's gain as a share of 1.
    pub gain_sigma: f64,
    /// Distance over which what the surface and the light model get wrong goes together, metres: the residuals within it
    /// tell as much as one. Taken for independent, they let views drift along with a surface that is slowly wrong. 0.045 to 0.09 are
    /// as good on most scans; smaller values make a head all round worse.
    pub correlation_m: f64,
    /// Gauss-Newton steps a turn of a round.
    pub iterations: usize,
}

impl Default for AlignmentParams {
    fn default() -> Self {
        AlignmentParams {
            rotation_sigma_rad: 0.003,
            translation_sigma_m: 0.0015,
            gain_sigma: 0.015,
            correlation_m: 0.07,
            iterations: 3,
        }
    }
}

/// Where on the way of a camera that moved over its pause an image was taken, as its light tells: standard deviation as a share of the way.
/// On a pot it was right to 0.03 to 0.12 (RMS); where the light does not tell it is farther off, and looser views cost next to nothing.
const WAY_SIGMA: f64 = 0.3;

impl AlignmentParams {
    /// Inverse covariance of a turn (rad) about the object's centre and a shift (m) of a view, of whose `way` over a pause a share may be
    /// amiss.
    fn weights(&self, way: Option<Vector6<f64>>) -> Matrix6<f64> {
        let [r, t] = [self.rotation_sigma_rad, self.translation_sigma_m].map(|s| 1.0 / (s * s));
        let tracked = Matrix6::from_diagonal(&Vector6::new(r, r, r, t, t, t));
        let Some(way) = way else { return tracked };
        // The inverse of a covariance to which the way adds (Sherman and Morrison).
        let along = WAY_SIGMA * way;
        let weighted = tracked * along;
        tracked - weighted * weighted.transpose() / (1.0 + along.dot(&weighted))
    }
}

/// The surface as alignment sees it.
pub struct AlignmentTarget<'a> {
    /// The sites of its mesh.
    pub sites: &'a Sites,
    /// Those to align by, of those that the view sees.
    pub chosen: &'a [u32],
    /// How many sites each of them stands for.
    pub stands_for: f64,
    /// Albedo of each site.
    pub albedo: &'a [f64],
    /// Centre of the object, world frame.
    pub centre: Point3<f64>,
    /// Loss of the residuals.
    pub loss: Tukey,
}

impl AlignmentTarget<'_> {
    /// Calls `each` with every site to align by that the view shows, its area (m²) and what it looks like.
    pub fn each_sample(&self, view: &View, mut each: impl FnMut(usize, f64, &Sample)) {
        let points = self
            .chosen
            .iter()
            .map(|&site| &self.sites.points[site as usize]);
        Gaze::new(view).each(points, |index, look| {
            let site = self.chosen[index] as usize;
            if let Some(sample) = self.sites.sample(site, view, look) {
                each(site, self.sites.areas_m2[site], &sample);
            }
        });
    }
}

type Matrix7 = SMatrix<f64, 7, 7>;
type Vector7 = SVector<f64, 7>;

/// Refines the pose and the gain of a view.
pub fn align_view(view: &mut View, target: &AlignmentTarget, params: &AlignmentParams) {
    for _ in 0..params.iterations {
        let (jtj, jtr) = normal_equations(view, target, params);
        let Some(cholesky) = jtj.cholesky() else {
            return;
        };
        let step = cholesky.solve(&-jtr);
        let motion: Vector6<f64> = step.fixed_rows::<6>(0).into();
        let centre = (view.camera_from_world * target.centre).coords;
        view.camera_from_world = increment_about(&centre, &motion) * view.camera_from_world;
        view.gain *= step[6].exp();
    }
}

fn normal_equations(
    view: &View,
    target: &AlignmentTarget,
    params: &AlignmentParams,
) -> (Matrix7, Vector7) {
    let centre = view.camera_from_world * target.centre;
    let (mut jtj, mut jtr) = prior(view, &centre, params);
    let correlated_m2 = params.correlation_m * params.correlation_m;
    target.each_sample(view, |site, area, sample| {
        let Some((residual, row)) = row(view, sample, target.albedo[site], &centre) else {
            return;
        };
        let correlated = sample.foreshortened_m2(area) / correlated_m2;
        let independent = correlated.min(1.0) * target.stands_for;
        let weight = target.loss.weight(residual) * independent;
        jtj += row * row.transpose() * weight;
        jtr += row * (residual * weight);
    });
    (jtj, jtr)
}

/// Residual of a site and its derivative by turn, shift and log gain.
fn row(view: &View, sample: &Sample, albedo: f64, centre: &Point3<f64>) -> Option<(f64, Vector7)> {
    let look = &sample.look;
    let (light, n) = (view.light(), &sample.normal_camera);
    let prediction = albedo * sample.unit_prediction;
    let scale = look.gain * albedo;
    let by_normal = (look.arriving() + sample.highlight.by_normal) * -scale;
    // Light over other surfaces and the highlight are taken to stay as the point moves.
    let by_point =
        view.image_gradient(look)? - light.irradiance_by_point(&look.point_camera, n) * scale;
    // A turn ω moves the point by ω × lever and the normal by ω × n.
    let lever = look.point_camera - centre;
    let by_turn = lever.cross(&by_point) + n.cross(&by_normal);
    let row = Vector7::from_column_slice(&[
        by_turn.x,
        by_turn.y,
        by_turn.z,
        by_point.x,
        by_point.y,
        by_point.z,
        -prediction,
    ]);
    Some(((look.observed - prediction) / look.sigma, row / look.sigma))
}

/// A motion as a turn about a centre and a shift.
fn about(motion: &Pose, centre: &Point3<f64>) -> Vector6<f64> {
    let shift = motion * centre - centre;
    increment_of(&Pose::from_parts(shift.into(), motion.rotation))
}

/// Prior that ties the view to its tracked pose and to gain 1.
fn prior(view: &View, centre: &Point3<f64>, params: &AlignmentParams) -> (Matrix7, Vector7) {
    let offset = about(
        &(view.camera_from_world * view.tracked_camera_from_world.inverse()),
        centre,
    );
    let way = view.moved.map(|moved| about(&moved, centre));
    let weights = params.weights(way);
    let g = params.gain_sigma.powi(-2);
    let mut jtj = Matrix7::zeros();
    jtj.fixed_view_mut::<6, 6>(0, 0).copy_from(&weights);
    jtj[(6, 6)] = g;
    let mut jtr = Vector7::zeros();
    jtr.fixed_rows_mut::<6>(0).copy_from(&(weights * offset));
    jtr[6] = g * view.gain.ln();
    (jtj, jtr)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_may_slide_along_its_way_and_no_farther_aside() {
        let params = AlignmentParams::default();
        let way = Vector6::new(0.0, 0.02, 0.0, 0.01, 0.0, -0.015);
        let of = |weights: Matrix6<f64>, offset: Vector6<f64>| offset.dot(&(weights * offset));
        let (tracked, loose) = (params.weights(None), params.weights(Some(way)));
        let along = WAY_SIGMA * way;
        let (held, slid) = (of(tracked, along), of(loose, along));
        assert!(
            held > 5.0 && (slid - held / (1.0 + held)).abs() < 1e-9,
            "{held} {slid}"
        );
        // Nothing of the way's, weighted: neither a roll nor a shift upwards.
        let aside = Vector6::new(0.001, 0.0, 0.0, 0.0, 0.002, 0.0);
        assert!((of(loose, aside) - of(tracked, aside)).abs() < 1e-9);
    }
}
