//! Judging a surface by images that it was not made from, as in Section 5 of the paper.
//!
//! Views that refinement did not use are aligned with the base surface and with the refined one, each is rendered in them
//! pixel by pixel ([`render`]), and both are compared with what was observed: in intensity, which shows slow shape and
//! albedo, and in its gradient, which shows detail. Compared are the pixels that both surfaces cover with what views learnt from show:
//! of the rest refinement says nothing.

use super::albedo::Albedo;
use super::rendering::render;
use super::rounds::{Rounds, State, UnseenSurface};
use super::sites::ViewSet;
use super::view::View;
use crate::geometry::TriMesh;
use depth_camera::Image;
use nalgebra::Vector2;
use rayon::prelude::*;
use serde::Serialize;

/// Every so many views one is held out.
const EVERY: usize = 4;

/// How far a rendered image is from the observed one, root mean square, as a share of the mean observed linear intensity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ImageError {
    /// Of the intensity.
    pub intensity: f64,
    /// Of its gradient, per pixel.
    pub gradient: f64,
}

/// One view that was held out, or all of them together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct HeldOut {
    /// Pixels compared.
    pub n_pixels: usize,
    /// The base surface.
    pub base: ImageError,
    /// The refined surface.
    pub refined: ImageError,
    /// What the sensor's noise alone would leave.
    pub noise: ImageError,
    /// Root mean square of the gains, less 1, by which slow differences of brightness were taken up on the refined surface. Of a light that
    /// is not steady, how bright the images are as wholes says nothing.
    pub slow_gain: f64,
}

impl HeldOut {
    /// As it is reported: where no pixel was compared its figures are no numbers. To judge by, they are 0, by which neither surface is
    /// better.
    pub fn reported(self) -> HeldOut {
        if self.n_pixels > 0 {
            return self;
        }
        let none = ImageError {
            intensity: f64::NAN,
            gradient: f64::NAN,
        };
        HeldOut {
            n_pixels: 0,
            base: none,
            refined: none,
            noise: none,
            slow_gain: f64::NAN,
        }
    }
}

/// What the views that were held out say.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Judgement {
    /// Each of them by its number among the shading images.
    pub views: Vec<(usize, HeldOut)>,
    /// All pixels of all of them.
    pub overall: HeldOut,
}

impl Judgement {
    /// Puts together what single views say.
    pub fn of(judged: &[JudgedView]) -> Self {
        let sums = judged.iter().map(|view| &view.sums);
        let total = sums.fold(Sums::default(), Sums::plus);
        Judgement {
            views: judged
                .iter()
                .map(|view| (view.index, view.figures()))
                .collect(),
            overall: total.means(),
        }
    }

    /// How many of them show anything of the surface, and so judge it.
    pub fn n_comparing(&self) -> usize {
        let views = self.views.iter();
        views.filter(|(_, said)| said.n_pixels > 0).count()
    }

    /// Whether the base surface explains them better, in intensity or in its gradient.
    pub fn prefers_base(&self) -> bool {
        let HeldOut { base, refined, .. } = &self.overall;
        // What is no number confirms nothing.
        !(refined.intensity <= base.intensity && refined.gradient <= base.gradient)
    }
}

/// A view with what it was held out to judge.
#[derive(Clone, Debug)]
pub struct JudgedView {
    /// Its number among the shading images.
    pub index: usize,
    /// Observed less rendered linear intensity on the base surface, NaN where not compared.
    pub base_error: Image<f32>,
    /// The same on the refined surface.
    pub refined_error: Image<f32>,
    sums: Sums,
}

impl JudgedView {
    /// What it says.
    pub fn figures(&self) -> HeldOut {
        self.sums.means()
    }
}

/// The views to hold out of a set: a quarter, spread over the scan; none of a single one.
pub fn hold_out(set: ViewSet) -> ViewSet {
    let views = (0..ViewSet::BITS).filter(|view| set >> view & 1 == 1);
    let held_out = views.skip(1).step_by(EVERY);
    held_out.fold(0, |held_out, view| held_out | 1 << view)
}

/// Every so many-th view from the first, of as many as a set can hold.
pub fn every(first: usize, step: usize, n_views: usize) -> ViewSet {
    (first..n_views.min(ViewSet::BITS as usize))
        .step_by(step)
        .fold(0, |set, view| set | 1 << view)
}

/// Lets a set of views judge a base state and a refined one, by the sites that others told of; they are left aligned with the refined
/// surface.
pub fn judge(
    rounds: &Rounds,
    base: &State,
    refined: &mut State,
    is_told: &[bool],
    held_out: ViewSet,
) -> Vec<JudgedView> {
    let State {
        surface,
        views,
        albedo,
    } = refined;
    let base = rounds.unseen(&base.surface.mesh, &base.albedo, is_told);
    let refined = rounds.unseen(&surface.mesh, albedo, is_told);
    let held_out = views
        .par_iter_mut()
        .with_max_len(1)
        .enumerate()
        .filter(|(view, _)| held_out >> view & 1 == 1);
    held_out
        .map(|(index, view)| {
            let base = settle_and_render(rounds, &base, &mut view.clone());
            let refined = settle_and_render(rounds, &refined, view);
            JudgedView {
                index,
                sums: Sums::over(view, &base, &refined),
                base_error: error(view, &base),
                refined_error: error(view, &refined),
            }
        })
        .collect()
}

/// Root mean square of the gains, less 1, by which a set of views differs slowly in brightness from a mesh with its albedo, where
/// others told of it; `None` where they show nothing of that. How bright the images are as wholes counts by any light: of two
/// calibrations it tells most.
pub fn slow_gain(
    rounds: &Rounds,
    (mesh, albedo): (&TriMesh, &Albedo),
    is_told: &[bool],
    views: &[View],
    judges: ViewSet,
) -> Option<f64> {
    let surface = rounds.unseen(mesh, albedo, is_told);
    let judging = views.par_iter().with_max_len(1).enumerate();
    let judging = judging.filter(|(view, _)| judges >> view & 1 == 1);
    let sums = judging.map(|(_, view)| {
        let mut view = view.clone();
        let rendered = settle_and_render(rounds, &surface, &mut view);
        Sums::over(&view, &rendered, &rendered)
    });
    let sums: Vec<Sums> = sums.collect();
    let total = sums.iter().fold(Sums::default(), Sums::plus);
    (total.n_pixels > 0.0).then(|| (total.gain_of_wholes / total.n_pixels).sqrt())
}

fn settle_and_render(rounds: &Rounds, surface: &UnseenSurface, view: &mut View) -> Image<f32> {
    let sites = rounds.settle(view, surface);
    render(view, surface.mesh, (&sites, 0), surface.albedo)
}

fn error(view: &View, rendered: &Image<f32>) -> Image<f32> {
    let linear = view.linear();
    let pixels = linear.integrated.data().iter().zip(linear.value.data());
    let pixels = pixels.zip(rendered.data());
    let errors = pixels.map(|((integrated, value), rendered)| match value.is_nan() {
        true => f32::NAN,
        false => integrated - rendered,
    });
    Image::from_vec(rendered.width(), rendered.height(), errors.collect())
}

/// Sums of squares over the pixels of a view: of base, refined surface and noise.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    n_pixels: f64,
    observed: f64,
    intensity: [f64; 3],
    n_gradients: f64,
    gradient: [f64; 3],
    slow_gain: f64,
    /// The same where wholes count by any light.
    gain_of_wholes: f64,
}

impl Sums {
    fn over(view: &View, base: &Image<f32>, refined: &Image<f32>) -> Sums {
        let linear = view.linear();
        let (width, height) = (base.width(), base.height());
        // Observed, its errors on both surfaces, and its variance; `None` where a pixel cannot be used.
        let pixel = |u: usize, v: usize| -> Option<[f64; 4]> {
            let observed = f64::from(*linear.integrated.at(u, v));
            let (base, refined) = (f64::from(*base.at(u, v)), f64::from(*refined.at(u, v)));
            let sigma = f64::from(*linear.sigma.at(u, v));
            let usable = !(linear.value.at(u, v).is_nan() || base.is_nan() || refined.is_nan());
            usable.then_some([observed, observed - base, observed - refined, sigma * sigma])
        };
        let mut sums = Sums::default();
        let (mut gains, mut squared_gains) = (0.0, 0.0);
        for v in 1..height - 1 {
            for u in 1..width - 1 {
                let Some([observed, base, refined, variance]) = pixel(u, v) else {
                    continue;
                };
                sums.n_pixels += 1.0;
                sums.observed += observed;
                let gain = view.gain * view.gain_field.at(&Vector2::new(u as f64, v as f64));
                gains += gain;
                squared_gains += gain * gain;
                for (sum, square) in
                    sums.intensity
                        .iter_mut()
                        .zip([base * base, refined * refined, variance])
                {
                    *sum += square;
                }
                let beside = [
                    pixel(u - 1, v),
                    pixel(u + 1, v),
                    pixel(u, v - 1),
                    pixel(u, v + 1),
                ];
                let [Some(left), Some(right), Some(above), Some(below)] = beside else {
                    continue;
                };
                sums.n_gradients += 1.0;
                // Central differences; noise of two pixels, halved, on each axis.
                for surface in 0..2 {
                    let du = 0.5 * (right[1 + surface] - left[1 + surface]);
                    let dv = 0.5 * (below[1 + surface] - above[1 + surface]);
                    sums.gradient[surface] += du * du + dv * dv;
                }
                sums.gradient[2] += 0.25 * (left[3] + right[3] + above[3] + below[3]);
            }
        }
        // Squares of scaled gains less 1.
        let squares = |scale: f64| {
            (squared_gains * scale * scale - 2.0 * gains * scale + sums.n_pixels).max(0.0)
        };
        sums.gain_of_wholes = squares(1.0);
        sums.slow_gain = match view.is_light_steady() {
            true => sums.gain_of_wholes,
            false => squares(sums.n_pixels / gains.max(f64::MIN_POSITIVE)),
        };
        sums
    }

    fn plus(mut self, other: &Sums) -> Sums {
        self.n_pixels += other.n_pixels;
        self.observed += other.observed;
        self.n_gradients += other.n_gradients;
        self.slow_gain += other.slow_gain;
        self.gain_of_wholes += other.gain_of_wholes;
        for k in 0..3 {
            self.intensity[k] += other.intensity[k];
            self.gradient[k] += other.gradient[k];
        }
        self
    }

    fn means(&self) -> HeldOut {
        let mean = self.observed / self.n_pixels.max(1.0);
        let share =
            |square: f64, n: f64| (square / n.max(1.0)).sqrt() / mean.max(f64::MIN_POSITIVE);
        let error = |k: usize| ImageError {
            intensity: share(self.intensity[k], self.n_pixels),
            gradient: share(self.gradient[k], self.n_gradients),
        };
        HeldOut {
            n_pixels: self.n_pixels as usize,
            base: error(0),
            refined: error(1),
            noise: error(2),
            slow_gain: (self.slow_gain / self.n_pixels.max(1.0)).sqrt(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nothing_judged_has_no_figures_and_prefers_no_surface() {
        let judgement = Judgement::of(&[]);
        assert!(!judgement.prefers_base());
        let reported = judgement.overall.reported();
        for error in [reported.base, reported.refined, reported.noise] {
            assert!(error.intensity.is_nan() && error.gradient.is_nan());
        }
        assert!(reported.slow_gain.is_nan());
        let judged = HeldOut {
            n_pixels: 1,
            ..HeldOut::default()
        };
        assert_eq!(judged.reported(), judged);
    }

    #[test]
    fn a_quarter_is_held_out_and_never_the_only_view() {
        let of_first = |n_views| hold_out(every(0, 1, n_views));
        assert_eq!(of_first(1), 0);
        assert_eq!(of_first(2), 0b10);
        assert_eq!(of_first(8), 0b10_0010);
        assert_eq!(hold_out(0b1110_1110), 0b1000_0100);
        assert_eq!(every(130, 1, 132), 0, "no set holds them");
        for n_views in 2..=64 {
            let share = f64::from(of_first(n_views).count_ones()) / n_views as f64;
            assert!((0.2..=0.5).contains(&share), "{share} of {n_views}");
        }
    }
}
