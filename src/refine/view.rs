//! One shading image made ready for the solver: linear intensities, what hides the object from camera and light, and what is
//! predicted of a site in it ([`Sample`]). The residual of Eq. (6) is in `observations`, with its derivative by the site's motion;
//! those by a view's pose and gain are in `alignment`.

use super::edge_mask::mask_edges_and_occluders;
use super::gain_field::GainField;
use super::light_camera::light_camera;
use super::optics::Optics;
use crate::geometry::{CameraModel, Lens, Pose, TriMesh, rasterise};
use crate::interreflection::{IndirectLight, LitScene, PatchGrid, WhiteLevel};
use crate::shading::{Gloss, Highlight, LightTable, LinearImage, NearLight, SATURATION, linearise};
use crate::snapshot::ShadingSnapshot;
use depth_camera::Image;
use nalgebra::{Point3, Vector2, Vector3};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// What all views of one refinement share.
pub struct ViewContext<'a> {
    /// The whole base mesh, which hides the object from camera and light.
    pub scene: &'a TriMesh,
    /// Centre of the object, world frame.
    pub centre: Point3<f64>,
    /// No point of the object is farther from its centre, metres.
    pub radius_m: f64,
    /// Camera, light and response.
    pub optics: &'a Optics<'a>,
    /// The flat field of each pixel.
    pub flat: &'a Image<f64>,
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
    /// believed, and moved whole surfaces by a millimetre while pixels were held within a round. 0.1 to 0.3 are as good now.
    pub misregistration_px: f64,
    /// Slow differences of brightness over more than this distance on the object are not taken for shading, metres.
    pub gain_cell_m: f64,
    /// Root mean square of those differences from which on the light model is not believed at all: 0.007 to 0.011 where it
    /// fits, up to 0.033 where neither depth is corrected nor indirect light predicted, 0.032 to 0.048 with gamma 1.4 for 0.87. Gamma 1.1
    /// gives 0.019 to 0.029 and is not found so.
    /// A quarter of the share of light that is predicted to come over other surfaces is added as squares are. Of a light that is not steady
    /// ([`Optics::is_steady`]) only differences within each image count.
    pub max_slow_gain: f64,
}

impl Default for ImageTrust {
    fn default() -> Self {
        ImageTrust {
            model_error: 0.01,
            misregistration_px: 0.2,
            gain_cell_m: 0.08,
            max_slow_gain: 0.032,
        }
    }
}

/// A shading image with its pose and gain as far as they are known; clones share the image.
#[derive(Clone, Debug)]
pub struct View {
    camera: CameraModel,
    lens: Lens,
    light: NearLight,
    is_light_steady: bool,
    light_table: Arc<LightTable>,
    indirect: Arc<IndirectLight>,
    /// The white level if the brightest surfaces of this view are plaster.
    pub plausible_white: Option<WhiteLevel>,
    /// What scales the indirect light; `None` for none.
    pub white: Option<WhiteLevel>,
    linear: Arc<LinearImage>,
    /// Which pixels are clear of depth edges.
    clear_of_edges: Arc<Image<bool>>,
    /// Surface seen from the camera, metres.
    camera_depth_m: Arc<Image<f32>>,
    light_lens: Lens,
    /// Surface seen from the light, metres.
    light_depth_m: Arc<Image<f32>>,
    /// Pose from tracking.
    pub tracked_camera_from_world: Pose,
    /// Along which motion of the camera, camera frame, the image may lie elsewhere: see [`ShadingSnapshot::moved`].
    pub moved: Option<Pose>,
    /// Pose refined by the images.
    pub camera_from_world: Pose,
    /// Brightness of this view against the others.
    pub gain: f64,
    /// Slow differences of brightness over this view's image.
    pub gain_field: GainField,
    trust: ImageTrust,
}

/// What hides is known to no less than this, metres.
pub const HIDING_CELL_M: f64 = 0.004;

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
    /// What arrives from the light: [`NearLight::incident`], camera frame.
    pub direct: Vector3<f64>,
    /// What arrives over other surfaces, in the same unit.
    pub indirect: Vector3<f64>,
}

impl Look {
    /// All light that arrives, as a vector whose product with the unit normal is the prediction for unit albedo and gain.
    #[inline]
    pub fn arriving(&self) -> Vector3<f64> {
        self.direct + self.indirect
    }
}

/// What a site looks like in a view.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// What the view shows there.
    pub look: Look,
    /// `gain · field · (n·E + highlight)`, with E as of [`Look::arriving`]: the prediction for unit albedo.
    pub unit_prediction: f64,
    /// The normal in the camera frame.
    pub normal_camera: Vector3<f64>,
    /// What gloss adds.
    pub highlight: Highlight,
}

impl Sample {
    /// A site's area as the camera sees it, m²: foreshortened.
    pub fn foreshortened_m2(&self, area_m2: f64) -> f64 {
        let from_camera = &self.look.point_camera.coords;
        area_m2 * (-from_camera.dot(&self.normal_camera) / from_camera.norm()).max(0.0)
    }

    /// How much a site of this area counts: the pixels that it covers, at most one.
    pub fn covered(&self, view: &View, area_m2: f64) -> f64 {
        let z = self.look.point_camera.z;
        (self.foreshortened_m2(area_m2) * view.pixels_per_sr() / (z * z)).min(1.0)
    }
}

impl View {
    /// Linearises a snapshot and renders what hides the object in it.
    pub fn new(snapshot: &ShadingSnapshot, context: &ViewContext) -> View {
        let ViewContext {
            scene,
            centre,
            radius_m,
            optics,
            flat,
            trust,
            patches,
        } = *context;
        let camera = *optics.rays.camera();
        let camera_from_world = snapshot.world_from_camera.inverse();
        let camera_depth_m = rasterise(scene, &camera, &camera_from_world).depth_m;
        let light_from_camera = nalgebra::Translation3::from(-optics.light.position.coords);
        let light_from_world = light_from_camera * camera_from_world;
        let centre_light = light_from_world * centre;
        let light_model =
            light_camera(&centre_light, radius_m, &optics.light.position, optics.rays);
        let light_depth_m = rasterise(scene, &light_model, &light_from_world).depth_m;
        let counts = snapshot.lit_counts(optics.full_scale, optics.calibration.gamma);
        let mut linear = linearise(
            &counts,
            optics.full_scale,
            SATURATION,
            optics.calibration,
            flat,
        );
        let clear_of_edges = mask_edges_and_occluders(
            optics,
            &mut linear.value,
            &camera_depth_m,
            &snapshot.depth_m,
        );
        let model_depth_m = camera_depth_m.map(|&z| if z.is_finite() { z } else { 0.0 });
        let lit = LitScene::new(patches, &model_depth_m, &counts);
        let distance_m = (camera_from_world * centre).z.max(0.1);
        let cell_px = (trust.gain_cell_m * camera.intrinsics().fx / distance_m).max(4.0);
        View {
            camera,
            lens: Lens::new(&camera),
            light: optics.light,
            is_light_steady: optics.is_steady,
            light_table: Arc::new(LightTable::new(&optics.light)),
            indirect: Arc::new(IndirectLight::new(&lit, &model_depth_m, optics.rays)),
            plausible_white: lit.plausible_white(),
            white: None,
            linear: Arc::new(linear),
            clear_of_edges: Arc::new(clear_of_edges),
            camera_depth_m: Arc::new(camera_depth_m),
            light_lens: Lens::new(&light_model),
            light_depth_m: Arc::new(light_depth_m),
            tracked_camera_from_world: camera_from_world,
            moved: snapshot.moved,
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

    /// Derivative of the observed intensity by the point in the camera frame, per metre.
    pub fn image_gradient(&self, look: &Look) -> Option<Vector3<f64>> {
        let (_, jacobian) = self.camera.project_with_jacobian(&look.point_camera)?;
        let [du, dv] = look.gradient;
        Some((jacobian.row(0) * du + jacobian.row(1) * dv).transpose())
    }

    /// What a site looks like in this view, by what the view shows there; `None` where its pixel is unusable or it faces away
    /// from the light.
    pub fn sample(
        &self,
        look: &Look,
        normal_world: &Vector3<f64>,
        gloss: &Gloss,
    ) -> Option<Sample> {
        let normal_camera = self.camera_from_world * normal_world;
        let highlight = gloss.highlight(&look.point_camera, &normal_camera, &look.direct);
        let irradiance = normal_camera.dot(&look.arriving()) + highlight.value;
        (irradiance > 0.0 && !look.observed.is_nan()).then_some(Sample {
            look: *look,
            unit_prediction: look.gain * irradiance,
            normal_camera,
            highlight,
        })
    }

    /// The camera.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// The image.
    pub fn linear(&self) -> &LinearImage {
        &self.linear
    }

    /// Which pixels are clear of depth edges, so that no other surface is mixed in.
    pub fn clear_of_edges(&self) -> &Image<bool> {
        &self.clear_of_edges
    }

    /// The light.
    pub fn light(&self) -> &NearLight {
        &self.light
    }

    /// The camera in single precision.
    pub fn lens(&self) -> &Lens {
        &self.lens
    }

    /// Whether the light is as bright in every image: [`Optics::is_steady`].
    pub fn is_light_steady(&self) -> bool {
        self.is_light_steady
    }

    /// The light in single precision.
    pub fn light_table(&self) -> &LightTable {
        &self.light_table
    }

    /// What the light would see as a camera.
    pub fn light_lens(&self) -> &Lens {
        &self.light_lens
    }

    /// Surface seen from the camera, metres.
    pub fn camera_depth_m(&self) -> &Image<f32> {
        &self.camera_depth_m
    }

    /// Surface seen from the light, metres.
    pub fn light_depth_m(&self) -> &Image<f32> {
        &self.light_depth_m
    }

    /// What arrives over other surfaces.
    pub fn indirect(&self) -> &IndirectLight {
        &self.indirect
    }

    /// How far Eq. (1) is believed.
    pub fn trust(&self) -> &ImageTrust {
        &self.trust
    }

    /// Pixels that a square metre covers one metre before the camera and facing it.
    pub fn pixels_per_sr(&self) -> f64 {
        let i = self.camera.intrinsics();
        i.fx * i.fy
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
