//! One shading image made ready for the solver: linear intensities, what hides the object from camera and light, and the
//! residual of Eq. (6) with its derivatives.

use super::gain_field::GainField;
use super::optics::Optics;
use crate::geometry::{CameraModel, Pose, TriMesh, rasterise};
use crate::interreflection::{IndirectLight, LitScene, PatchGrid, WhiteLevel};
use crate::shading::{Gloss, Highlight, LinearImage, NearLight, linearise};
use crate::snapshot::ShadingSnapshot;
use depth_camera::{Image, Intrinsics};
use nalgebra::{Point3, Vector2, Vector3};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// What all views of one refinement share.
pub struct ViewContext<'a> {
    /// The whole base mesh, which hides the object from camera and light.
    pub scene: &'a TriMesh,
    /// Centre of the object, world frame.
    pub centre: Point3<f64>,
    /// Camera, light and response.
    pub optics: &'a Optics<'a>,
    /// How far Eq. (1) is believed.
    pub trust: &'a ImageTrust,
    /// The patches that light one another in every image.
    pub patches: &'a PatchGrid,
}

/// What a pixel's noise is not: how far Eq. (1), the poses and the sampling can be believed.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImageTrust {
    /// Standard deviation of the model as a share of the intensity: texture of the albedo, interreflection, lobe.
    pub model_error: f64,
    /// Standard deviation of where a site falls on the image, pixels: what alignment leaves and the blur of steps that are
    /// narrower than a pixel. It makes residuals count less where the image is steep; without it rims of the relief were
    /// believed, and moved whole surfaces by a millimetre.
    pub misregistration_px: f64,
    /// Slow differences of brightness over more than this distance on the object are not taken for shading, metres.
    pub gain_cell_m: f64,
    /// Root mean square of those differences from which on the light model is not believed at all: 0.010 to 0.019 where it
    /// fits, 0.042 with gamma 0.5 for 0.87, 0.074 with the light 0.2 m off. Gamma 1.4 for 0.87 gives 0.016 and is not found.
    pub max_slow_gain: f64,
}

impl Default for ImageTrust {
    fn default() -> Self {
        ImageTrust {
            model_error: 0.01,
            misregistration_px: 0.4,
            gain_cell_m: 0.08,
            max_slow_gain: 0.032,
        }
    }
}

/// A shading image with its pose and gain as far as they are known; clones share the image.
#[derive(Clone, Debug)]
pub struct View {
    camera: CameraModel,
    light: NearLight,
    indirect: Arc<IndirectLight>,
    /// The white level if the brightest surfaces of this view are plaster.
    pub plausible_white: Option<WhiteLevel>,
    /// Gloss of the surface.
    pub gloss: Gloss,
    /// What scales the indirect light; `None` for none.
    pub white: Option<WhiteLevel>,
    linear: Arc<LinearImage>,
    /// Surface seen from the camera, metres.
    camera_depth_m: Arc<Image<f32>>,
    light_model: CameraModel,
    /// Surface seen from the light, metres.
    light_depth_m: Arc<Image<f32>>,
    /// Pose from tracking.
    pub tracked_camera_from_world: Pose,
    /// Pose refined by the images.
    pub camera_from_world: Pose,
    /// Brightness of this view against the others.
    pub gain: f64,
    /// Slow differences of brightness over this view's image.
    pub gain_field: GainField,
    trust: ImageTrust,
}

/// From this share of full scale a pixel counts as saturated.
pub const SATURATION: f64 = 0.985;
/// A point this far behind the surface of a depth buffer is hidden, metres; covers the tracker's error and the buffer's.
const HIDDEN_BEYOND_M: f64 = 0.004;
/// What hides is known to no less than this, metres.
pub const HIDING_CELL_M: f64 = 0.004;
/// Live depth nearer than the model by this much is something in front of it, metres.
const OCCLUDER_M: f32 = 0.015;
/// Depth differences beyond this between pixels two apart are an edge, metres; 78° at 0.6 m on Kinect II.
const DEPTH_EDGE_M: f32 = 0.02;
/// Cosines of incidence below this are grazing, at the camera and at the light.
const MIN_COSINE: f64 = 0.25;

/// What a view shows at a point.
#[derive(Clone, Copy, Debug)]
pub struct Look {
    /// Observed linear intensity.
    pub observed: f64,
    /// Its gradient on the image, per pixel.
    pub gradient: [f64; 2],
    /// Its standard deviation.
    pub sigma: f64,
    /// Where it was taken, pixels.
    pub pixel: Vector2<f64>,
    /// `gain · field` at that pixel.
    pub gain: f64,
    /// The point in the camera frame, metres.
    pub point_camera: Point3<f64>,
}

/// What a site looks like in a view.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// What the view shows there.
    pub look: Look,
    /// `gain · field · (n·E + highlight)`, with E as of [`View::arriving`]: the prediction for unit albedo.
    pub unit_prediction: f64,
    /// The normal in the camera frame.
    pub normal_camera: Vector3<f64>,
}

impl Sample {
    /// How much a facet of this area counts: the pixels that it covers, at most one.
    pub fn covered(&self, view: &View, area_m2: f64) -> f64 {
        let per_m2 = view.pixels_per_m2(&self.look.point_camera);
        (area_m2 * per_m2.dot(&self.normal_camera)).clamp(0.0, 1.0)
    }
}

impl View {
    /// Linearises a snapshot and renders what hides the object in it.
    pub fn new(snapshot: &ShadingSnapshot, context: &ViewContext) -> View {
        let ViewContext {
            scene,
            centre,
            optics,
            trust,
            patches,
        } = *context;
        let camera = *optics.rays.camera();
        let camera_from_world = snapshot.world_from_camera.inverse();
        let camera_depth_m = rasterise(scene, &camera, &camera_from_world).depth_m;
        let light_model = light_camera_model();
        let light_from_camera = nalgebra::Translation3::from(-optics.light.position.coords);
        let light_depth_m = rasterise(
            scene,
            &light_model,
            &(light_from_camera * camera_from_world),
        )
        .depth_m;
        let counts = snapshot.lit_counts(optics.full_scale, optics.calibration.gamma);
        let mut linear = linearise(
            &counts,
            optics.full_scale,
            SATURATION,
            optics.calibration,
            optics.rays,
        );
        mask_edges_and_occluders(&mut linear.value, &camera_depth_m, &snapshot.depth_m);
        let model_depth_m = camera_depth_m.map(|&z| if z.is_finite() { z } else { 0.0 });
        let lit = LitScene::new(patches, &model_depth_m, &counts);
        let distance_m = (camera_from_world * centre).z.max(0.1);
        let cell_px = (trust.gain_cell_m * camera.intrinsics().fx / distance_m).max(4.0);
        View {
            camera,
            light: optics.light,
            indirect: Arc::new(IndirectLight::new(&lit, &model_depth_m, optics.rays)),
            plausible_white: lit.plausible_white(),
            white: None,
            gloss: Gloss::default(),
            linear: Arc::new(linear),
            camera_depth_m: Arc::new(camera_depth_m),
            light_model,
            light_depth_m: Arc::new(light_depth_m),
            tracked_camera_from_world: camera_from_world,
            camera_from_world,
            gain: 1.0,
            gain_field: GainField::flat(
                camera.intrinsics().width,
                camera.intrinsics().height,
                cell_px,
            ),
            trust: trust.clone(),
        }
    }

    /// Whether the view sees a point of the surface well enough to learn from it: unhidden from camera and light, not
    /// grazing, and its pixel usable.
    pub fn sees(&self, point_world: &Point3<f64>, normal_world: &Vector3<f64>) -> bool {
        // Hiding is judged where the tracker put the camera, since the buffers were rendered from there.
        let point = self.tracked_camera_from_world * point_world;
        let normal = self.tracked_camera_from_world * normal_world;
        let to_light = self.light.position - point;
        let facing =
            |direction: &Vector3<f64>| normal.dot(direction) > MIN_COSINE * direction.norm();
        if !facing(&-point.coords) || !facing(&to_light) {
            return false;
        }
        let point_light = Point3::from(-to_light);
        unhidden(&self.camera, &self.camera_depth_m, &point)
            && unhidden(&self.light_model, &self.light_depth_m, &point_light)
            && self.shows(point_world)
    }

    /// Whether the pixels at a point are usable.
    fn shows(&self, point_world: &Point3<f64>) -> bool {
        let pixel = self.camera.project(&(self.camera_from_world * point_world));
        pixel.is_some_and(|pixel| self.linear.has(pixel.x, pixel.y))
    }

    /// What this view shows at a point; `None` where its pixel is unusable.
    pub fn look(&self, point_world: &Point3<f64>) -> Option<Look> {
        let point_camera = self.camera_from_world * point_world;
        let pixel = self.camera.project(&point_camera)?;
        let (observed, gradient, noise) = self.linear.sample(pixel.x, pixel.y)?;
        let slope_squared = gradient[0] * gradient[0] + gradient[1] * gradient[1];
        let sigma = (noise * noise
            + (self.trust.model_error * observed).powi(2)
            + self.trust.misregistration_px.powi(2) * slope_squared)
            .sqrt();
        Some(Look {
            observed,
            gradient,
            sigma,
            pixel,
            gain: self.gain * self.gain_field.at(&pixel),
            point_camera,
        })
    }

    /// What a site looks like in this view; `None` where its pixel is unusable or it faces away from the light.
    pub fn sample(&self, point_world: &Point3<f64>, normal_world: &Vector3<f64>) -> Option<Sample> {
        let look = self.look(point_world)?;
        let normal_camera = self.camera_from_world * normal_world;
        let irradiance = self.irradiance(&look.point_camera, &look.pixel, &normal_camera);
        let unit_prediction = look.gain * irradiance;
        (unit_prediction > 0.0).then_some(Sample {
            look,
            unit_prediction,
            normal_camera,
        })
    }

    /// `gain · field · (n·E + highlight)`, with E as of [`Self::arriving`], at a point, whatever its pixel showed; `None` where it does not project or is not lit.
    pub fn unit_prediction(
        &self,
        point_world: &Point3<f64>,
        normal_world: &Vector3<f64>,
    ) -> Option<f64> {
        let point_camera = self.camera_from_world * point_world;
        let pixel = self.camera.project(&point_camera)?;
        if !self.camera.contains(&pixel, 0.0) {
            return None;
        }
        let normal_camera = self.camera_from_world * normal_world;
        let irradiance = self.irradiance(&point_camera, &pixel, &normal_camera);
        (irradiance > 0.0).then(|| self.gain * self.gain_field.at(&pixel) * irradiance)
    }

    /// Derivative of the observed intensity by the point in the camera frame, per metre.
    pub fn image_gradient(&self, look: &Look) -> Option<Vector3<f64>> {
        let (_, jacobian) = self.camera.project_with_jacobian(&look.point_camera)?;
        let [du, dv] = look.gradient;
        Some((jacobian.row(0) * du + jacobian.row(1) * dv).transpose())
    }

    /// Light that arrives at a point (m, camera frame), from the light as of Eq. (1) and over other surfaces, as a vector
    /// whose product with the unit normal is the prediction for unit albedo and gain.
    #[inline]
    pub fn arriving(&self, point_camera: &Point3<f64>, pixel: &Vector2<f64>) -> Vector3<f64> {
        let direct = self.light.incident(point_camera);
        self.white
            .map_or(direct, |white| direct + self.indirect.at(pixel, white))
    }

    /// Whether gloss adds anything.
    pub fn is_glossy(&self) -> bool {
        self.gloss.strength > 0.0
    }

    /// What gloss adds at a point (m, camera frame).
    #[inline]
    pub fn highlight(&self, point_camera: &Point3<f64>, normal_camera: &Vector3<f64>) -> Highlight {
        if !self.is_glossy() {
            return Highlight::default();
        }
        let direct = self.light.incident(point_camera);
        self.gloss.highlight(point_camera, normal_camera, &direct)
    }

    /// Prediction for unit albedo and gain.
    fn irradiance(
        &self,
        point_camera: &Point3<f64>,
        pixel: &Vector2<f64>,
        normal_camera: &Vector3<f64>,
    ) -> f64 {
        let matte = normal_camera.dot(&self.arriving(point_camera, pixel));
        matte + self.highlight(point_camera, normal_camera).value
    }

    /// The camera.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// The image.
    pub fn linear(&self) -> &LinearImage {
        &self.linear
    }

    /// The light.
    pub fn light(&self) -> &NearLight {
        &self.light
    }

    /// Pixels that a square metre of surface covers at a point, as a vector whose product with the unit normal (camera frame)
    /// foreshortens it; negative seen from behind.
    pub fn pixels_per_m2(&self, point_camera: &Point3<f64>) -> Vector3<f64> {
        let i = self.camera.intrinsics();
        let distance = point_camera.coords.norm();
        point_camera.coords * (-i.fx * i.fy / (distance * point_camera.z * point_camera.z))
    }

    /// Where a point appears in this view, pixels.
    pub fn pixel(
        &self,
        point_world: &Point3<f64>,
        camera_from_world: &Pose,
    ) -> Option<Vector2<f64>> {
        self.camera.project(&(camera_from_world * point_world))
    }

    /// Pixels that carry shading information: white where used.
    pub fn mask(&self) -> Image<u8> {
        self.linear
            .value
            .map(|value| if value.is_nan() { 0 } else { 255 })
    }
}

/// The light's "camera" for shadows: a pinhole with the camera's orientation and a field of 100°.
fn light_camera_model() -> CameraModel {
    const SIDE: usize = 800;
    let focal = SIDE as f64 / 2.0 / 50.0f64.to_radians().tan();
    CameraModel::new(Intrinsics {
        width: SIDE,
        height: SIDE,
        fx: focal,
        fy: focal,
        cx: (SIDE - 1) as f64 / 2.0,
        cy: (SIDE - 1) as f64 / 2.0,
        k1: 0.0,
        k2: 0.0,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    })
}

/// Whether a point lies on or before the surface of a depth buffer; of the four pixels round it the farthest counts, since
/// the nearest may belong to another surface's rim.
fn unhidden(camera: &CameraModel, depth_m: &Image<f32>, point: &Point3<f64>) -> bool {
    let Some(pixel) = camera.project(point) else {
        return false;
    };
    if !camera.contains(&pixel, 2.0) {
        return false;
    }
    let (u, v) = (pixel.x as usize, pixel.y as usize);
    [(0, 0), (1, 0), (0, 1), (1, 1)]
        .iter()
        .all(|(du, dv)| point.z < *depth_m.at(u + du, v + dv) as f64 + HIDDEN_BEYOND_M)
}

/// Marks pixels at depth edges of the model, and where the live depth sees something in front of it, as unusable (NaN).
fn mask_edges_and_occluders(
    linear: &mut Image<f32>,
    model_depth_m: &Image<f32>,
    live_depth_m: &Image<f32>,
) {
    const REACH: usize = 2;
    let (width, height) = (linear.width(), linear.height());
    let mut usable = vec![false; width * height];
    for v in REACH..height - REACH {
        for u in REACH..width - REACH {
            let centre = *model_depth_m.at(u, v);
            if !centre.is_finite() {
                continue;
            }
            let smooth = (v - REACH..=v + REACH).all(|y| {
                model_depth_m.row(y)[u - REACH..=u + REACH]
                    .iter()
                    .all(|z| (z - centre).abs() < DEPTH_EDGE_M)
            });
            let live = *live_depth_m.at(u, v);
            usable[v * width + u] = smooth && !(live > 0.0 && live < centre - OCCLUDER_M);
        }
    }
    for (value, usable) in linear.data_mut().iter_mut().zip(usable) {
        if !usable {
            *value = f32::NAN;
        }
    }
}
