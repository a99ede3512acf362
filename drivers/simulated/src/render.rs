//! Pictures of a scene without a sensor's faults: depth and the radiance under a near light.

use depth_camera::{Image, Intrinsics};
use nalgebra::{Isometry3, Point3, Vector3};

use crate::{optics, scene::Scene};

/// Nothing further away is seen, metres.
const FAR_M: f64 = 6.0;

/// A shadow ray starts this far off its surface, metres: more than the tracer's tolerance, less than any relief.
const OFF_SURFACE_M: f64 = 5e-5;

/// Offsets of the four rays of a pixel.
const SUBPIXELS: [[f64; 2]; 4] = [[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]];

/// The rays of all pixels of a camera.
#[derive(Clone, Debug)]
pub(crate) struct Lens {
    pub(crate) intrinsics: Intrinsics,
    /// Four rays (x, y, 1) a pixel; `None` where the lens has none.
    rays: Vec<[Option<[f64; 2]>; 4]>,
}

/// What one pixel sees, the mean over its four rays.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Sample {
    /// Along the optical axis, metres; 0 where a ray met nothing, or the rays met a step in depth.
    pub(crate) depth_m: f64,
    /// Cosine between the normal and the line of sight.
    pub(crate) cos_incidence: f64,
    pub(crate) albedo: f64,
    /// Albedo × cosine ÷ squared distance × lobe × lens, per square metre; 0 in the light's shadow.
    pub(crate) radiance: f64,
    /// Whether the light's position sees the first ray's point.
    pub(crate) lit: bool,
}

/// A point light and how the picture darkens towards its corners.
#[derive(Clone, Copy, Debug)]
pub(crate) struct NearLight {
    /// Camera frame, metres.
    pub(crate) position_m: [f64; 3],
    /// Exponent of the emission's cosine about the optical axis, by the direction from the light.
    pub(crate) lobe_power: f64,
    /// Exponent of the cosine by which the lens darkens, by the direction from the camera.
    pub(crate) lens_power: f64,
}

impl Lens {
    /// The rays of a camera.
    pub(crate) fn new(intrinsics: Intrinsics) -> Self {
        let (width, height) = (intrinsics.width, intrinsics.height);
        let ray = |pixel: usize, [du, dv]: [f64; 2]| {
            let (u, v) = ((pixel % width) as f64, (pixel / width) as f64);
            optics::ray_through(&intrinsics, u + du, v + dv)
        };
        let rays = (0..width * height)
            .map(|pixel| SUBPIXELS.map(|offset| ray(pixel, offset)))
            .collect();
        Lens { intrinsics, rays }
    }

    /// The picture of a scene under a light that moves with the camera.
    pub(crate) fn render(
        &self,
        scene: &Scene,
        world_from_camera: &Isometry3<f64>,
        light: &NearLight,
    ) -> Image<Sample> {
        let view = View {
            scene,
            eye_world: Point3::from(world_from_camera.translation.vector),
            world_from_camera: *world_from_camera,
            light_world: world_from_camera * Point3::from(light.position_m),
            axis_world: world_from_camera.rotation * Vector3::z(),
            light: *light,
        };
        let pixels = self.rays.iter().map(|rays| view.sample(rays)).collect();
        Image::from_vec(self.intrinsics.width, self.intrinsics.height, pixels)
    }

    /// Depth at the pixels' centres, metres; 0 where nothing is.
    pub(crate) fn true_depth(
        &self,
        scene: &Scene,
        world_from_camera: &Isometry3<f64>,
    ) -> Image<f32> {
        let (width, height) = (self.intrinsics.width, self.intrinsics.height);
        let eye_world = Point3::from(world_from_camera.translation.vector);
        let depth = |pixel: usize| {
            let (u, v) = ((pixel % width) as f64, (pixel / width) as f64);
            let [x, y] = optics::ray_through(&self.intrinsics, u, v)?;
            let direction = world_from_camera * Vector3::new(x, y, 1.0);
            let hit = scene.trace(&eye_world, &direction, FAR_M)?;
            Some(hit.distance as f32)
        };
        let depths = (0..width * height).map(|pixel| depth(pixel).unwrap_or(0.0));
        Image::from_vec(width, height, depths.collect())
    }
}

/// A camera and its light in a scene.
struct View<'a> {
    scene: &'a Scene,
    world_from_camera: Isometry3<f64>,
    eye_world: Point3<f64>,
    light_world: Point3<f64>,
    /// The optical axis, forwards.
    axis_world: Vector3<f64>,
    light: NearLight,
}

impl View<'_> {
    fn sample(&self, rays: &[Option<[f64; 2]>; 4]) -> Sample {
        let found = rays.map(|ray| ray.and_then(|ray| self.sample_ray(ray)));
        let seen = || found.iter().flatten();
        let n_seen = seen().count();
        if n_seen == 0 {
            return Sample::default();
        }
        let mean = |value: fn(&Sample) -> f64| seen().map(value).sum::<f64>() / n_seen as f64;
        let nearest = seen().map(|s| s.depth_m).fold(f64::MAX, f64::min);
        let furthest = seen().map(|s| s.depth_m).fold(0.0, f64::max);
        let depth_m = mean(|s| s.depth_m);
        let whole = n_seen == rays.len() && furthest - nearest < 0.01 * depth_m;
        Sample {
            depth_m: if whole { depth_m } else { 0.0 },
            cos_incidence: mean(|s| s.cos_incidence),
            albedo: mean(|s| s.albedo),
            // Rays that meet nothing are dark.
            radiance: mean(|s| s.radiance) * n_seen as f64 / rays.len() as f64,
            lit: seen().next().is_some_and(|s| s.lit),
        }
    }

    fn sample_ray(&self, [x, y]: [f64; 2]) -> Option<Sample> {
        // The ray has unit depth: distance along it is depth.
        let direction = self.world_from_camera.rotation * Vector3::new(x, y, 1.0);
        let hit = self.scene.trace(&self.eye_world, &direction, FAR_M)?;
        let point = self.eye_world + direction * hit.distance;
        let normal = self.scene.normal_of(hit.solid, &point);
        let albedo = self.scene.albedo_of(hit.solid, &point);
        let cos_axis = 1.0 / direction.norm();

        let to_light = self.light_world - point;
        let distance_m = to_light.norm();
        let cos_light = normal.dot(&to_light) / distance_m;
        let start = point + normal * OFF_SURFACE_M;
        let lit = cos_light > 0.0 && !self.scene.blocked(&start, &self.light_world);
        // Nothing is emitted backwards.
        let cos_lobe = (-to_light.dot(&self.axis_world) / distance_m).max(0.0);
        let radiance = albedo * cos_light / distance_m.powi(2)
            * cos_lobe.powf(self.light.lobe_power)
            * cos_axis.powf(self.light.lens_power);
        Some(Sample {
            depth_m: hit.distance,
            cos_incidence: -normal.dot(&direction) * cos_axis,
            albedo,
            radiance: if lit { radiance } else { 0.0 },
            lit,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{sensor, trajectory::Trajectory};
    use depth_camera::Sensor;

    #[test]
    fn rays_end_on_the_surface_and_meet_nothing_before_it() {
        let lens = Lens::new(optics::reduced(&sensor::intrinsics(Sensor::Kinect2), 4));
        let path = Trajectory::hand_held(Point3::new(0.0, 0.0, 0.1), 48);
        for scene in [Scene::plaque(), Scene::sphere(), Scene::bumpy_sphere()] {
            let pose = path.world_from_camera(5);
            let depth = lens.true_depth(&scene, &pose);
            let mut n_hits = 0;
            for (pixel, &depth_m) in depth.data().iter().enumerate() {
                let (u, v) = (pixel % 128, pixel / 128);
                let ray = optics::ray_through(&lens.intrinsics, u as f64, v as f64);
                let [x, y] = ray.unwrap();
                let at = |z: f64| pose * Point3::new(x * z, y * z, z);
                let z = f64::from(depth_m);
                if depth_m > 0.0 {
                    n_hits += 1;
                    // The tracer's tolerance, which grazing rays need.
                    let off_m = scene.signed_distance(&at(z)).abs();
                    assert!(off_m < 6e-6, "{off_m} m off at pixel {u}, {v}");
                }
                let free_m = if depth_m > 0.0 { z - 1e-3 } else { 1.5 };
                let free = (20..(free_m * 200.0) as usize).map(|step| step as f64 / 200.0);
                assert!(
                    free.into_iter()
                        .all(|z| scene.signed_distance(&at(z)) > -1e-6)
                );
            }
            assert!(n_hits > 5000);
        }
    }
}
