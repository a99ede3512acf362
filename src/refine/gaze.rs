//! A view that looks at many points: which of them it sees, and what it shows there.
//!
//! In single precision, [`LANES`] points at a time. Places on the image are right to 10⁻⁴ pixels, intensities and light to 10⁻⁵ of
//! themselves.

mod surfels;

use super::view::{Look, View};
use crate::geometry::lanes::{LANES, Lane, floor};
use crate::geometry::{Lens, Projected, Rigid};
use crate::shading::{Gloss, between_pixels};
use depth_camera::Image;
use nalgebra::{Point3, Vector2, Vector3};
use pulp::{Arch, Simd, WithSimd};
pub use surfels::{Lanes3, Surfels, set_lane};
use surfels::{by_lane, dot, dots};

/// A point this far behind the surface of a depth buffer is hidden, metres; covers the tracker's error and the buffer's.
const HIDDEN_BEYOND_M: f32 = 0.004;
/// Cosines of incidence below this are grazing, at the camera and at the light: 80°. With 84° surfaces come out the same, and real ones are
/// least Lambertian there (docs/experiments-refinement.md).
const MIN_COSINE: f32 = 0.17;
/// Pixels from a depth buffer's rim within which nothing is known to hide a point or not.
const RIM_PX: f32 = 2.0;

/// A view as it looks from where it is.
pub struct Gaze<'a> {
    view: &'a View,
    arch: Arch,
    tracked: Rigid,
    refined: Rigid,
}

/// What a view shows at some points.
pub struct Looks {
    /// Whether the point lies in the image; the rest means nothing otherwise.
    pub is_inside: [bool; LANES],
    /// Place on the image, pixels.
    pub pixel: [Lane; 2],
    /// Observed linear intensity; NaN where a pixel is unusable.
    pub observed: Lane,
    /// Its gradient, per pixel.
    pub gradient: [Lane; 2],
    /// Its standard deviation.
    pub sigma: Lane,
    /// `gain · field`.
    pub gain: Lane,
    /// The point in the camera frame, metres.
    pub point: Lanes3,
    /// What arrives from the light, and over other surfaces, camera frame.
    pub direct: Lanes3,
    /// Over other surfaces.
    pub indirect: Lanes3,
}

impl Looks {
    /// One of them; `None` where the point lies outside the image.
    #[inline]
    pub fn get(&self, lane: usize) -> Option<Look> {
        let vector = |of: &Lanes3| Vector3::from([0, 1, 2].map(|axis| f64::from(of[axis][lane])));
        self.is_inside[lane].then(|| Look {
            observed: f64::from(self.observed[lane]),
            gradient: self.gradient.map(|of| f64::from(of[lane])),
            sigma: f64::from(self.sigma[lane]),
            pixel: Vector2::from(self.pixel.map(|of| f64::from(of[lane]))),
            gain: f64::from(self.gain[lane]),
            point_camera: Point3::from(vector(&self.point)),
            direct: vector(&self.direct),
            indirect: vector(&self.indirect),
        })
    }
}

/// What the solver needs of some points in a view, per standard deviation of what was observed, world frame.
pub struct Weighed {
    /// Observed linear intensity; NaN where there is none.
    pub observed: Lane,
    /// What arrives, gloss among it.
    pub light: Lanes3,
    /// Pixels that a square metre covers; negative seen from behind.
    pub pixels_per_m2: Lane,
    /// Whether the pixels are clear of depth edges.
    pub is_clear: [bool; LANES],
    /// What changes as the points move.
    pub slopes: Slopes,
}

/// A surface as it is: what a view would show of it, and its albedo at some points.
#[derive(Clone, Copy)]
pub struct AsItIs<'a> {
    /// Linear intensity, the pixels' blur taken off; NaN where it is not known.
    pub image: &'a Image<f32>,
    /// Albedo at the points.
    pub albedo: &'a Lane,
}

/// How what a view shows changes as the points move, per metre and standard deviation of what was observed; 0 where they do not.
#[derive(Default)]
pub struct Slopes {
    /// The observed intensity.
    pub image: Lane,
    /// The prediction for unit albedo.
    pub light: Lane,
}

impl<'a> Gaze<'a> {
    /// How a view looks.
    pub fn new(view: &'a View) -> Self {
        Gaze {
            view,
            arch: Arch::new(),
            tracked: Rigid::new(&view.tracked_camera_from_world),
            refined: Rigid::new(&view.camera_from_world),
        }
    }

    /// Whether the view sees points (world frame, metres) of a surface with these normals well enough to learn from: unhidden from
    /// camera and light, not grazing, and their pixels usable.
    pub fn sees(&self, points: &Lanes3, normals: &Lanes3) -> [bool; LANES] {
        self.arch.dispatch(See {
            gaze: self,
            points,
            normals,
        })
    }

    /// What the view shows at points (world frame, metres).
    pub fn looks(&self, points: &Lanes3) -> Looks {
        self.arch.dispatch(LookAt { gaze: self, points })
    }

    /// What it shows of pieces of a surface as the solver needs it, with how that changes as they move `along` vectors, if they do. What
    /// pixels mix of a surface `as_it_is` beside them is taken off what is observed.
    pub fn weighed(
        &self,
        surfels: &Surfels,
        along: Option<&Lanes3>,
        as_it_is: Option<AsItIs>,
    ) -> Weighed {
        self.arch.dispatch(Weigh {
            gaze: self,
            surfels,
            along,
            as_it_is,
        })
    }

    /// What the view would show of pieces of a surface of albedo 1, linear; NaN outside the image and where it is not lit.
    pub fn predictions(&self, surfels: &Surfels) -> Lane {
        self.arch.dispatch(Predict {
            gaze: self,
            surfels,
        })
    }

    /// Where points (world frame, metres) fall, columns and rows; NaN outside the image.
    pub fn pixels_of(&self, points: &[Point3<f64>]) -> Vec<[f32; 2]> {
        let mut places = Vec::with_capacity(points.len());
        for points in points.chunks(LANES) {
            let mut lanes = [[0.0; LANES]; 3];
            for (lane, point) in points.iter().enumerate() {
                set_lane(&mut lanes, lane, &point.coords);
            }
            let ([u, v], is_inside) = self.arch.dispatch(Locate {
                gaze: self,
                points: &lanes,
            });
            places.extend((0..points.len()).map(|lane| match is_inside[lane] {
                true => [u[lane], v[lane]],
                false => [f32::NAN; 2],
            }));
        }
        places
    }

    /// Calls `each` with the number of every point (world frame, metres) in the image and what the view shows there.
    pub fn each<'p>(
        &self,
        points: impl Iterator<Item = &'p Point3<f64>>,
        mut each: impl FnMut(usize, &Look),
    ) {
        let (mut lanes, mut n) = ([[0.0; LANES]; 3], 0);
        let mut flush = |lanes: &Lanes3, first: usize, n: usize| {
            let looks = self.looks(lanes);
            for lane in 0..n {
                if let Some(look) = looks.get(lane) {
                    each(first + lane, &look);
                }
            }
        };
        for point in points {
            set_lane(&mut lanes, n % LANES, &point.coords);
            n += 1;
            if n % LANES == 0 {
                flush(&lanes, n - LANES, LANES);
            }
        }
        flush(&lanes, n - n % LANES, n % LANES);
    }

    #[inline(always)]
    fn sees_lanes(&self, points: &Lanes3, normals: &Lanes3) -> [bool; LANES] {
        // Hiding is judged where the tracker put the camera, since the buffers were rendered from there.
        let view = self.view;
        let light: [f32; 3] = view.light().position.coords.cast::<f32>().into();
        let (mut seen, mut place) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
        let mut from_light = [[0.0; LANES]; 3];
        let mut is_seen = [false; LANES];
        for i in 0..LANES {
            let point = [0, 1, 2].map(|axis| points[axis][i]);
            let p = self.tracked.point(point);
            let normal = self.tracked.turn([0, 1, 2].map(|axis| normals[axis][i]));
            let q = [0, 1, 2].map(|axis| p[axis] - light[axis]);
            is_seen[i] = is_facing(&normal, &p) & is_facing(&normal, &q);
            let refined = self.refined.point(point);
            for axis in 0..3 {
                seen[axis][i] = p[axis];
                from_light[axis][i] = q[axis];
                place[axis][i] = refined[axis];
            }
        }
        keep_unhidden(view.lens(), view.camera_depth_m(), &seen, &mut is_seen);
        keep_unhidden(
            view.light_lens(),
            view.light_depth_m(),
            &from_light,
            &mut is_seen,
        );
        let (pixel, is_inside) = pixels(view.lens(), &place);
        let shown = &view.linear().value;
        let (width, first) = (shown.width(), firsts(shown.width(), &pixel));
        for i in 0..LANES {
            if is_seen[i] {
                let (at, below) = (first[i], first[i] + width);
                let corners = [at, at + 1, below, below + 1].map(|k| shown.data()[k]);
                is_seen[i] = is_inside[i] && corners.iter().all(|value| !value.is_nan());
            }
        }
        is_seen
    }

    #[inline(always)]
    fn looks_lanes(&self, points: &Lanes3) -> Looks {
        let (view, trust) = (self.view, self.view.trust());
        let point = self.placed(points);
        let (pixel, is_inside) = pixels(view.lens(), &point);
        let [u, v] = &pixel;
        let shown = view.linear().samples(u, v);
        let mut gain = view.gain_field.at_lanes(u, v);
        // As below, no closure.
        let indirect = match view.white {
            Some(white) => view.indirect().at(u, v, white),
            None => [[0.0; LANES]; 3],
        };
        let whole = view.gain as f32;
        let (model, place) = (trust.model_error as f32, trust.misregistration_px as f32);
        let mut sigma = [0.0; LANES];
        for i in 0..LANES {
            let [du, dv] = [shown.gradient[0][i], shown.gradient[1][i]];
            let [noise, model] = [shown.sigma[i], model * shown.value[i]];
            let misplaced = place * place * (du * du + dv * dv);
            sigma[i] = (noise * noise + model * model + misplaced).sqrt();
            gain[i] *= whole;
        }
        Looks {
            is_inside,
            pixel,
            observed: shown.value,
            gradient: shown.gradient,
            sigma,
            gain,
            direct: view.light_table().incident(&point),
            indirect,
            point,
        }
    }

    #[allow(
        clippy::needless_range_loop,
        reason = "one index runs through all the lanes, which is what becomes vector code"
    )]
    #[inline(always)]
    fn weighed_lanes(
        &self,
        surfels: &Surfels,
        along: Option<&Lanes3>,
        as_it_is: Option<AsItIs>,
    ) -> Weighed {
        let looks = self.looks_lanes(&surfels.points);
        let normals = self.turned(&surfels.normals);
        let arriving = arriving(&looks, &normals, surfels.gloss.as_ref());
        let mut weighed = Weighed {
            observed: [f32::NAN; LANES],
            light: [[0.0; LANES]; 3],
            pixels_per_m2: [0.0; LANES],
            is_clear: [false; LANES],
            // No closure of an `Option`, which would be compiled without vector instructions.
            slopes: match along {
                Some(along) => self.slopes(&looks, &normals, &self.turned(along)),
                None => Slopes::default(),
            },
        };
        let mixed = match as_it_is {
            Some(surface) => mixed(&looks, &normals, &arriving, surface),
            None => [0.0; LANES],
        };
        let pixels_per_sr = self.view.pixels_per_sr() as f32;
        let clear = self.view.clear_of_edges();
        let first = firsts(clear.width(), &looks.pixel);
        for i in 0..LANES {
            let inv_sigma = 1.0 / looks.sigma[i];
            let [x, y, z] = [0, 1, 2].map(|axis| looks.point[axis][i]);
            let distance = (x * x + y * y + z * z).sqrt();
            let per_m2 = -pixels_per_sr / (distance * z * z);
            let scale = looks.gain[i] * inv_sigma;
            let light = [0, 1, 2].map(|axis| arriving[axis][i] * scale);
            let light = self.refined.turn_back(light);
            let normal = [0, 1, 2].map(|axis| normals[axis][i]);
            weighed.pixels_per_m2[i] = per_m2 * dot(&normal, &[x, y, z]);
            for axis in 0..3 {
                weighed.light[axis][i] = light[axis];
            }
            let (at, below) = (first[i], first[i] + clear.width());
            let corners = [at, at + 1, below, below + 1];
            weighed.is_clear[i] = corners.iter().all(|&k| clear.data()[k]);
            let observed = (looks.observed[i] - mixed[i]) * inv_sigma;
            weighed.observed[i] = if looks.is_inside[i] {
                observed
            } else {
                f32::NAN
            };
        }
        weighed
    }

    #[inline(always)]
    fn predictions_lanes(&self, surfels: &Surfels) -> Lane {
        let looks = self.looks_lanes(&surfels.points);
        let normals = self.turned(&surfels.normals);
        let arriving = arriving(&looks, &normals, surfels.gloss.as_ref());
        let irradiance = dots(&arriving, &normals);
        let mut predictions = [f32::NAN; LANES];
        for i in 0..LANES {
            if looks.is_inside[i] && irradiance[i] > 0.0 {
                predictions[i] = looks.gain[i] * irradiance[i];
            }
        }
        predictions
    }

    /// Points of the world in the camera frame.
    #[inline(always)]
    fn placed(&self, points: &Lanes3) -> Lanes3 {
        by_lane(points, |point| self.refined.point(point))
    }

    /// Vectors of the world in the camera frame.
    #[inline(always)]
    fn turned(&self, vectors: &Lanes3) -> Lanes3 {
        by_lane(vectors, |vector| self.refined.turn(vector))
    }

    /// How what is seen changes as points move along vectors, which like the normals are in the camera frame. Gain, light over other
    /// surfaces and gloss are taken to stay.
    #[inline(always)]
    fn slopes(&self, looks: &Looks, normals: &Lanes3, along: &Lanes3) -> Slopes {
        /// Half a millimetre is a third of a pixel, far from the rounding of its place.
        const STEP_M: f32 = 5e-4;
        let mut ahead = looks.point;
        for (ahead, along) in ahead.iter_mut().zip(along) {
            for i in 0..LANES {
                ahead[i] += STEP_M * along[i];
            }
        }
        let light = self.view.light_table();
        let by_motion = light.irradiance_along(&looks.point, &looks.direct, normals, along);
        let (pixel, is_inside) = pixels(self.view.lens(), &ahead);
        let mut slopes = Slopes::default();
        for i in 0..LANES {
            slopes.light[i] = by_motion[i] * looks.gain[i] / looks.sigma[i];
            let [du, dv] = [0, 1].map(|axis| pixel[axis][i] - looks.pixel[axis][i]);
            let step = looks.gradient[0][i] * du + looks.gradient[1][i] * dv;
            let slope = step / (STEP_M * looks.sigma[i]);
            slopes.image[i] = if is_inside[i] { slope } else { 0.0 };
        }
        slopes
    }
}

/// What arrives, gloss among it, from what is seen of a surface with these normals, camera frame.
#[inline(always)]
fn arriving(looks: &Looks, normals: &Lanes3, gloss: Option<&[Gloss; LANES]>) -> Lanes3 {
    let mut arriving = looks.direct;
    for (sum, indirect) in arriving.iter_mut().zip(&looks.indirect) {
        for i in 0..LANES {
            sum[i] += indirect[i];
        }
    }
    if let Some(gloss) = gloss {
        add_gloss(looks, normals, gloss, &mut arriving);
    }
    arriving
}

/// Adds what gloss sends, as light whose product with the normal (camera frame) has the highlight's value and slope.
fn add_gloss(looks: &Looks, normals: &Lanes3, gloss: &[Gloss; LANES], arriving: &mut Lanes3) {
    for (i, gloss) in gloss.iter().enumerate() {
        let normal = Vector3::from([0, 1, 2].map(|axis| f64::from(normals[axis][i])));
        let Some(look) = looks.get(i).filter(|_| normal != Vector3::zeros()) else {
            continue;
        };
        let highlight = gloss.highlight(&look.point_camera, &normal, &look.direct);
        // The slope lies across the normal: value and slope are right there.
        let sent = normal * highlight.value + highlight.by_normal;
        for axis in 0..3 {
            arriving[axis][i] += sent[axis] as f32;
        }
    }
}

/// By how much an image of a surface as it is differs from the prediction at points of it; 0 where that is not known.
#[inline(always)]
fn mixed(looks: &Looks, normals: &Lanes3, arriving: &Lanes3, surface: AsItIs) -> Lane {
    let [u, v] = &looks.pixel;
    let (mut mixed, _) = between_pixels(surface.image, u, v);
    let irradiance = dots(arriving, normals);
    for i in 0..LANES {
        let difference = mixed[i] - surface.albedo[i] * looks.gain[i] * irradiance[i];
        mixed[i] = if difference.is_nan() { 0.0 } else { difference };
    }
    mixed
}

/// Whether a surface faces back along the way to it, and not at a grazing angle.
#[inline(always)]
fn is_facing(normal: &[f32; 3], way: &[f32; 3]) -> bool {
    let cosine = -dot(normal, way);
    (cosine > 0.0) & (cosine * cosine > MIN_COSINE * MIN_COSINE * dot(way, way))
}

/// Where points in the camera frame fall, and whether inside the image, so that four pixels lie round each; those that do not are
/// put on the first pixel.
#[inline(always)]
fn pixels(lens: &Lens, points: &Lanes3) -> ([Lane; 2], [bool; LANES]) {
    let [last_u, last_v] = lens.last();
    let (mut pixels, mut is_inside) = ([[0.0; LANES]; 2], [false; LANES]);
    for i in 0..LANES {
        let Projected { u, v, is_there } = lens.project([points[0][i], points[1][i], points[2][i]]);
        let inside = is_there & (u >= 0.0) & (v >= 0.0) & (u < last_u) & (v < last_v);
        pixels[0][i] = if inside { u } else { 0.0 };
        pixels[1][i] = if inside { v } else { 0.0 };
        is_inside[i] = inside;
    }
    (pixels, is_inside)
}

/// Index of the first of the four pixels round each place inside an image of this width.
#[inline(always)]
fn firsts(width: usize, [u, v]: &[Lane; 2]) -> [usize; LANES] {
    let width = width as i32;
    let mut first = [0; LANES];
    for i in 0..LANES {
        first[i] = floor(v[i]) * width + floor(u[i]);
    }
    first.map(|at| at as usize)
}

/// Keeps those points that no pixel of the four round each shows a surface before. One that is seen aslant from afar hides itself in
/// places, by what a pixel is deep; that leaves out what tells least (docs/experiments-refinement.md).
#[inline(always)]
fn keep_unhidden(lens: &Lens, depth_m: &Image<f32>, points: &Lanes3, kept: &mut [bool; LANES]) {
    let (pixel, is_inside) = pixels(lens, points);
    let first = firsts(depth_m.width(), &pixel);
    let [last_u, last_v] = lens.last();
    let (width, depths) = (depth_m.width(), depth_m.data());
    for i in 0..LANES {
        if !kept[i] {
            continue;
        }
        let (u, v) = (pixel[0][i], pixel[1][i]);
        let is_known = is_inside[i]
            && u >= RIM_PX
            && v >= RIM_PX
            && u <= last_u - RIM_PX
            && v <= last_v - RIM_PX;
        let (at, below) = (first[i], first[i] + width);
        let nearest = points[2][i] - HIDDEN_BEYOND_M;
        kept[i] = is_known
            && [at, at + 1, below, below + 1]
                .iter()
                .all(|&k| nearest < depths[k]);
    }
}

struct See<'a> {
    gaze: &'a Gaze<'a>,
    points: &'a Lanes3,
    normals: &'a Lanes3,
}

impl WithSimd for See<'_> {
    type Output = [bool; LANES];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> [bool; LANES] {
        self.gaze.sees_lanes(self.points, self.normals)
    }
}

struct LookAt<'a> {
    gaze: &'a Gaze<'a>,
    points: &'a Lanes3,
}

impl WithSimd for LookAt<'_> {
    type Output = Looks;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Looks {
        self.gaze.looks_lanes(self.points)
    }
}

struct Predict<'a> {
    gaze: &'a Gaze<'a>,
    surfels: &'a Surfels,
}

impl WithSimd for Predict<'_> {
    type Output = Lane;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Lane {
        self.gaze.predictions_lanes(self.surfels)
    }
}

struct Locate<'a> {
    gaze: &'a Gaze<'a>,
    points: &'a Lanes3,
}

impl WithSimd for Locate<'_> {
    type Output = ([Lane; 2], [bool; LANES]);

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        pixels(self.gaze.view.lens(), &self.gaze.placed(self.points))
    }
}

struct Weigh<'a> {
    gaze: &'a Gaze<'a>,
    surfels: &'a Surfels,
    along: Option<&'a Lanes3>,
    as_it_is: Option<AsItIs<'a>>,
}

impl WithSimd for Weigh<'_> {
    type Output = Weighed;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Weighed {
        self.gaze
            .weighed_lanes(self.surfels, self.along, self.as_it_is)
    }
}

#[cfg(test)]
mod tests;
