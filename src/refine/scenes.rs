//! Tiny scenes with closed-form answers for the tests of refinement.

use super::couplings::Couplings;
use super::energy::Problem;
use super::observations::Observations;
use super::optics::Optics;
use super::pattern::Pattern;
use super::priors::PriorWeights;
use super::rounds::final_loss;
use super::site_motion::SiteMotion;
use super::sites::{Sites, ViewSet};
use super::solver::{Solver, SolverParams};
use super::surface::Surface;
use super::view::{ImageTrust, View, ViewContext};
use super::{RefineParams, Subject, patches};
use crate::fusion::DepthNoise;
use crate::geometry::{CameraModel, EdgeAdjacency, Pose, RayGrid, TriMesh, increment};
use crate::shading::{Calibration, Gloss, NearLight};
use crate::snapshot::ShadingSnapshot;
use depth_camera::{Image, Intrinsics, Sensor};
use nalgebra::{Point3, Vector3, Vector6};

/// Full scale of the rendered counts.
pub const FULL_SCALE: f64 = 65535.0;
/// Albedo times light of the rendered surface, m².
pub const ALBEDO: f64 = 0.12;
/// Distance of the surface from the camera, metres.
const DISTANCE_M: f64 = 0.6;

/// A patch of 80 mm with ripples of a given amplitude and a wavelength of 12 mm, facing the camera at 0.6 m.
pub struct RippledPlane {
    /// Amplitude of the ripples, metres.
    pub amplitude_m: f64,
}

impl RippledPlane {
    /// Depth of the surface at a place.
    fn depth(&self, x: f64, y: f64) -> f64 {
        let k = 2.0 * std::f64::consts::PI / 0.012;
        DISTANCE_M + self.amplitude_m * (k * x).sin() * (k * y).cos()
    }

    /// Normal of the surface at a place, towards the camera.
    pub fn normal(&self, x: f64, y: f64) -> Vector3<f64> {
        let step = 1e-6;
        let slope_x = (self.depth(x + step, y) - self.depth(x - step, y)) / (2.0 * step);
        let slope_y = (self.depth(x, y + step) - self.depth(x, y - step)) / (2.0 * step);
        Vector3::new(slope_x, slope_y, -1.0)
            .try_normalize(0.0)
            .expect("z is -1")
    }

    /// The surface as a mesh of equilateral faces with edges of `edge_m`.
    pub fn mesh(&self, edge_m: f64) -> TriMesh {
        let half = 0.04;
        let row_m = edge_m * 0.75f64.sqrt();
        let (columns, rows) = (
            (2.0 * half / edge_m) as usize,
            (2.0 * half / row_m) as usize,
        );
        let mut mesh = TriMesh::default();
        for row in 0..rows {
            for column in 0..columns {
                let x = (column as f64 + 0.5 * (row % 2) as f64) * edge_m - half;
                let y = row as f64 * row_m - half;
                mesh.vertices.push(Point3::new(x, y, self.depth(x, y)));
            }
        }
        let at = |row: usize, column: usize| (row * columns + column) as u32;
        for row in 0..rows - 1 {
            for column in 0..columns - 1 {
                let (a, b) = (at(row, column), at(row, column + 1));
                let (c, d) = (at(row + 1, column), at(row + 1, column + 1));
                // Counter-clockwise seen from the camera, which looks along z with y down.
                if row % 2 == 0 {
                    mesh.faces.extend([[a, c, b], [b, c, d]]);
                } else {
                    mesh.faces.extend([[a, d, b], [a, c, d]]);
                }
            }
        }
        mesh
    }

    /// What a camera at a pose sees of it: Eq. (1) on the closed form, at pixel centres.
    pub fn snapshot(&self, optics: &Optics, world_from_camera: &Pose) -> ShadingSnapshot {
        let (mut counts, mut depths) = (Vec::new(), Vec::new());
        for [x, y] in optics.rays.rays().data() {
            let (depth, value) = self.render(*x as f64, *y as f64, optics, world_from_camera);
            depths.push(depth as f32);
            counts.push(value as f32);
        }
        image(optics, world_from_camera, counts, depths)
    }

    /// Adds what the plane shows if it is glossy.
    pub fn polish(&self, snapshot: &mut ShadingSnapshot, gloss: Gloss, optics: &Optics) {
        let world_from_camera = snapshot.world_from_camera;
        let rays = optics.rays.rays().data().iter();
        let pixels = snapshot.ir_counts.data_mut().iter_mut();
        for ((counts, depth), [x, y]) in pixels.zip(snapshot.depth_m.data()).zip(rays) {
            let (x, y) = (f64::from(*x), f64::from(*y));
            let point = Point3::new(x, y, 1.0) * f64::from(*depth);
            let on_plane = world_from_camera * point;
            let normal = world_from_camera.inverse() * self.normal(on_plane.x, on_plane.y);
            let highlight = gloss.highlight(&point, &normal, &optics.light.incident(&point));
            let gamma = optics.calibration.gamma;
            let flat = optics.calibration.flat_field.factor(x, y);
            let matte = (f64::from(*counts) / FULL_SCALE).powf(1.0 / gamma);
            *counts = (FULL_SCALE * (matte + ALBEDO * highlight.value * flat).powf(gamma)) as f32;
        }
    }

    /// Multiplies the plane's albedo by a factor that depends on the place.
    pub fn paint(
        snapshot: &mut ShadingSnapshot,
        optics: &Optics,
        factor: impl Fn(f64, f64) -> f64,
    ) {
        let pixels = snapshot.ir_counts.data_mut().iter_mut();
        let seen = optics
            .rays
            .rays()
            .data()
            .iter()
            .zip(snapshot.depth_m.data());
        for (counts, ([x, y], depth)) in pixels.zip(seen) {
            let seen = (Point3::new(*x, *y, 1.0) * *depth).cast::<f64>();
            let place = snapshot.world_from_camera * seen;
            *counts *= factor(place.x, place.y).powf(optics.calibration.gamma) as f32;
        }
    }

    /// Depth and counts along a ray.
    fn render(&self, x: f64, y: f64, optics: &Optics, world_from_camera: &Pose) -> (f64, f64) {
        let direction = world_from_camera.rotation * Vector3::new(x, y, 1.0);
        let origin = world_from_camera.translation.vector;
        let mut depth = DISTANCE_M;
        for _ in 0..30 {
            let p = origin + direction * depth;
            depth += (self.depth(p.x, p.y) - p.z) / direction.z;
        }
        let p = Point3::from(origin + direction * depth);
        let camera_from_world = world_from_camera.inverse();
        let normal = camera_from_world * self.normal(p.x, p.y);
        let linear = ALBEDO
            * optics
                .light
                .irradiance(&(camera_from_world * p), &normal)
                .max(0.0);
        let flat = optics.calibration.flat_field.factor(x, y);
        (
            depth,
            FULL_SCALE * (linear * flat).powf(optics.calibration.gamma),
        )
    }
}

/// A shading image from a pose, by the IR counts and depths (m) of its pixels.
pub fn image(
    optics: &Optics,
    world_from_camera: &Pose,
    counts: Vec<f32>,
    depths_m: Vec<f32>,
) -> ShadingSnapshot {
    let camera = optics.rays.camera().intrinsics();
    ShadingSnapshot {
        frame_id: 0,
        device_time_secs: 0.0,
        n_exposures: 1,
        ir_counts: Image::from_vec(camera.width, camera.height, counts),
        unlit_counts: None,
        depth_m: Image::from_vec(camera.width, camera.height, depths_m),
        world_from_camera: *world_from_camera,
        moved: None,
    }
}

/// Rays of a 200×160 camera whose pixels cover 1.2 mm at 0.6 m.
pub fn rays() -> RayGrid {
    RayGrid::new(CameraModel::new(Intrinsics {
        width: 200,
        height: 160,
        fx: 500.0,
        fy: 500.0,
        cx: 99.5,
        cy: 79.5,
        k1: 0.05,
        k2: -0.1,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    }))
}

/// The calibration of the scenes.
pub fn calibration() -> Calibration {
    Calibration::shipped(Sensor::Kinect2).expect("shipped")
}

/// Optics over given rays and calibration.
pub fn optics<'a>(rays: &'a RayGrid, calibration: &'a Calibration) -> Optics<'a> {
    Optics {
        rays,
        light: NearLight {
            position: Point3::new(0.05, 0.0, 0.004),
            lobe_power: calibration.light.lobe_power,
        },
        is_steady: true,
        full_scale: FULL_SCALE,
        calibration,
        depth_noise: DepthNoise::of_sensor(Sensor::Kinect2),
    }
}

/// Cameras that look at the middle of the surface from the front, tilted to all sides by `tilt_rad`.
pub fn poses(tilt_rad: f64) -> Vec<Pose> {
    [
        (0.0, 0.0),
        (1.0, 0.0),
        (-1.0, 0.0),
        (0.0, 1.0),
        (0.0, -1.0),
        (0.7, 0.7),
        (-0.7, 0.7),
    ]
    .iter()
    .map(|(x, y)| {
        let turn = increment(&Vector6::new(
            x * tilt_rad,
            y * tilt_rad,
            0.0,
            0.0,
            0.0,
            0.0,
        ));
        let centre = nalgebra::Translation3::new(0.0, 0.0, DISTANCE_M);
        centre * turn * centre.inverse()
    })
    .collect()
}

/// As [`poses`], by three tilts and from as many distances, which tells response and light.
pub fn poses_all_round() -> Vec<Pose> {
    let rings = [(0.3, 0.1), (0.6, 0.0), (0.9, -0.1)];
    let ring = |(tilt_rad, nearer_m): (f64, f64)| {
        let nearer = nalgebra::Translation3::new(0.0, 0.0, nearer_m);
        poses(tilt_rad).into_iter().map(move |pose| pose * nearer)
    };
    rings.into_iter().flat_map(ring).collect()
}

/// Views of a rippled plane whose `hidden` surface was rendered, placed against the mesh `base`.
pub fn views(hidden: &RippledPlane, base: &TriMesh, optics: &Optics, poses: &[Pose]) -> Vec<View> {
    let rendered = poses.iter().map(|pose| hidden.snapshot(optics, pose));
    views_of(&rendered.collect::<Vec<_>>(), base, optics)
}

/// Rendered images as they are believed to have been taken, placed against the mesh `base`.
pub fn views_of(snapshots: &[ShadingSnapshot], base: &TriMesh, believed: &Optics) -> Vec<View> {
    let trust = ImageTrust::default();
    let centre = Point3::new(0.0, 0.0, DISTANCE_M);
    let context = ViewContext {
        scene: base,
        centre,
        radius_m: base.radius_about(&centre),
        optics: believed,
        trust: &trust,
        flat: &believed.flat_image(),
        patches: &believed.patch_grid(),
    };
    let view = |snapshot| View::new(snapshot, &context);
    snapshots.iter().map(view).collect()
}

/// The whole mesh as the object.
pub fn whole<'a>(
    base: &'a TriMesh,
    snapshots: &'a [ShadingSnapshot],
    optics: &'a Optics,
) -> Subject<'a> {
    Subject {
        scene: base,
        object: base,
        snapshots,
        optics,
    }
}

/// A mesh that nothing has displaced yet.
pub fn surface_of(mesh: TriMesh) -> Surface {
    let n = mesh.vertices.len();
    Surface {
        directions: mesh.vertex_normals(),
        mesh,
        total_m: vec![0.0; n],
    }
}

/// Runs what asks how views of a `hidden` surface explain a mesh with edges of `params.edge_length_m`.
pub fn with_problem<T>(
    hidden: &RippledPlane,
    mesh: TriMesh,
    params: &RefineParams,
    run: impl FnOnce(&Problem, Surface, &Pattern) -> T,
) -> T {
    let (rays, calibration) = (rays(), calibration());
    let optics = optics(&rays, &calibration);
    let views = views(hidden, &mesh, &optics, &poses(0.5));
    let surface = surface_of(mesh);
    let sites = Sites::new(params.sites, &surface.mesh, &views, ViewSet::MAX);
    let edges = EdgeAdjacency::new(&surface.mesh);
    let patches = patches::cut(&surface.mesh, &surface.directions, params.patch_m);
    let couplings = Couplings::new(&surface.mesh, &edges, &patches);
    let motion = SiteMotion::of(&surface, params.sites, params.linearisation);
    let problem = Problem {
        observations: &Observations::new(&sites, &views, motion, None),
        labels: &vec![0; sites.points.len()],
        tints: &vec![1.0; sites.points.len()],
        finds_tints: false,
        sites: params.sites,
        loss: final_loss(3.0),
        priors: PriorWeights::new(params, params.edge_length_m),
        patches: &patches,
        edges: &edges,
        jacobian: params.jacobian,
    };
    let pattern = Pattern::new(&surface.mesh.vertices, couplings);
    run(&problem, surface, &pattern)
}

/// What one solve makes of such a mesh, and of an albedo to begin with.
pub fn solved(
    hidden: &RippledPlane,
    (mesh, albedo): (TriMesh, f64),
    params: &RefineParams,
    solver: &SolverParams,
) -> (Surface, f64) {
    with_problem(hidden, mesh, params, |problem, mut surface, pattern| {
        let mut albedos = vec![albedo];
        let solver = Solver {
            problem,
            pattern,
            params: *solver,
        };
        solver.minimise(&mut surface, &mut albedos, |_| true);
        (surface, albedos[0])
    })
}
