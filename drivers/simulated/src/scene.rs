//! What there is to see: solids in closed form, the rays that meet them, and the truth about them.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

use crate::{medallion, texture::Texture};

/// The part of a signed distance that a ray advances at a time: relief makes it fall by up to 1.17 a metre.
const STEP_SHARE: f64 = 0.85;

/// A ray that comes this close has met the surface; a last secant step takes it there.
const NEAR_M: f64 = 5e-6;

/// The form of a solid, in its own frame, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// The table's top: z = 0, so far along x and y.
    Table {
        /// Half its size.
        half_size: [f64; 2],
    },
    /// A sphere about the origin.
    Sphere {
        /// Its radius.
        radius: f64,
    },
    /// A cylinder about the z axis and its origin.
    Cylinder {
        /// Its radius.
        radius: f64,
        /// Half its height.
        half_height: f64,
    },
    /// A sphere whose radius carries ripples: the product of three sines of the direction.
    BumpySphere {
        /// Its mean radius.
        radius: f64,
        /// Largest deviation from it.
        amplitude: f64,
        /// Length of a ripple.
        wavelength: f64,
    },
    /// A box with rounded edges about the origin.
    RoundedBox {
        /// Half its size, edges included.
        half_size: [f64; 3],
        /// Radius of its edges.
        radius: f64,
    },
    /// A slab 0.20 m × 0.24 m about the origin, whose front (+z) carries a medallion over lettering.
    Plaque,
}

/// Half the plaque's thickness and the radius of its edges, metres.
const PLAQUE_HALF_DEPTH: f64 = 0.009;
const PLAQUE_EDGE: f64 = 0.002;

impl Shape {
    /// A function that is zero on the surface, positive outside and near it close to the distance.
    fn implicit(&self, p: &Vector3<f64>) -> f64 {
        match *self {
            Shape::Table { half_size: [x, y] } => {
                let beyond = (p.x.abs() - x).max(p.y.abs() - y).max(0.0);
                if beyond > 0.0 { p.z.hypot(beyond) } else { p.z }
            }
            Shape::Sphere { radius } => p.norm() - radius,
            Shape::Cylinder {
                radius,
                half_height,
            } => (p.x.hypot(p.y) - radius).max(p.z.abs() - half_height),
            Shape::BumpySphere {
                radius,
                amplitude,
                wavelength,
            } => {
                let distance = p.norm();
                let k = TAU / wavelength * radius / distance.max(1e-9);
                let ripple = (k * p.x).sin() * (k * p.y).sin() * (k * p.z).sin();
                distance - radius - amplitude * ripple
            }
            Shape::RoundedBox { half_size, radius } => rounded_box(p, &half_size, radius),
            Shape::Plaque => {
                let [x, y] = medallion::HALF_SIZE;
                let slab = rounded_box(p, &[x, y, PLAQUE_HALF_DEPTH], PLAQUE_EDGE);
                let over_front = p.z > 0.0 && p.x.abs() < x && p.y.abs() < y;
                // Further away than the relief is high, its height matters no more than that.
                match over_front && slab < 0.02 {
                    true => slab - medallion::height(p.x, p.y),
                    false if slab >= 0.02 => slab - medallion::HEIGHT_RANGE[1],
                    false => slab,
                }
            }
        }
    }

    /// Corners of a box about the solid.
    fn bounds(&self) -> [Vector3<f64>; 2] {
        let half = match *self {
            Shape::Table { half_size: [x, y] } => Vector3::new(x, y, 0.0),
            Shape::Sphere { radius } => Vector3::repeat(radius),
            Shape::Cylinder {
                radius,
                half_height,
            } => Vector3::new(radius, radius, half_height),
            Shape::BumpySphere {
                radius, amplitude, ..
            } => Vector3::repeat(radius + amplitude),
            Shape::RoundedBox { half_size, .. } => Vector3::from(half_size),
            Shape::Plaque => {
                let [x, y] = medallion::HALF_SIZE;
                let front = PLAQUE_HALF_DEPTH + medallion::HEIGHT_RANGE[1];
                return [
                    Vector3::new(-x, -y, -PLAQUE_HALF_DEPTH),
                    Vector3::new(x, y, front),
                ];
            }
        };
        [-half, half]
    }
}

/// Signed distance to a box whose edges are rounded.
fn rounded_box(p: &Vector3<f64>, half_size: &[f64; 3], radius: f64) -> f64 {
    let q = p.abs() - Vector3::from(*half_size).add_scalar(-radius);
    q.sup(&Vector3::zeros()).norm() + q.max().min(0.0) - radius
}

/// A shape somewhere in the world, of one albedo or with a pattern.
#[derive(Clone, Debug)]
pub struct Solid {
    shape: Shape,
    albedo: f64,
    texture: Option<Texture>,
    world_from_solid: Isometry3<f64>,
    /// The rotation of the inverse pose: a matrix turns a vector faster than a quaternion.
    solid_from_world: Matrix3<f64>,
    bounds: [Vector3<f64>; 2],
    /// A sphere about the bounds, world frame.
    centre: Vector3<f64>,
    radius: f64,
}

impl Solid {
    /// A shape at a pose; `albedo` is its IR reflectance, 0 to 1.
    pub fn new(shape: Shape, world_from_solid: Isometry3<f64>, albedo: f64) -> Self {
        let bounds = shape.bounds();
        let rotation = world_from_solid.rotation.to_rotation_matrix();
        let centre = world_from_solid * Point3::from((bounds[0] + bounds[1]) / 2.0);
        Solid {
            shape,
            albedo,
            texture: None,
            world_from_solid,
            solid_from_world: rotation.matrix().transpose(),
            bounds,
            centre: centre.coords,
            radius: (bounds[1] - bounds[0]).norm() / 2.0 + 1e-6,
        }
    }

    /// The same with a pattern about its albedo.
    pub fn with_texture(self, texture: Texture) -> Self {
        Solid {
            texture: Some(texture),
            ..self
        }
    }

    fn albedo(&self, point_world: &Point3<f64>) -> f64 {
        let factor = |texture: Texture| texture.factor(&self.to_local(point_world));
        self.albedo * self.texture.map_or(1.0, factor)
    }

    fn to_local(&self, point_world: &Point3<f64>) -> Vector3<f64> {
        self.solid_from_world * (point_world.coords - self.world_from_solid.translation.vector)
    }

    fn implicit(&self, point_world: &Point3<f64>) -> f64 {
        self.shape.implicit(&self.to_local(point_world))
    }

    /// Gradient of the implicit function, solid frame, by differences along the corners of a tetrahedron.
    fn gradient(&self, p: &Vector3<f64>) -> Vector3<f64> {
        const STEP: f64 = 1e-5;
        let corners = [
            Vector3::new(1.0, -1.0, -1.0),
            Vector3::new(-1.0, -1.0, 1.0),
            Vector3::new(-1.0, 1.0, -1.0),
            Vector3::new(1.0, 1.0, 1.0),
        ];
        corners
            .iter()
            .map(|corner| corner * self.shape.implicit(&(p + corner * STEP)))
            .sum::<Vector3<f64>>()
            / (4.0 * STEP)
    }

    /// Where a ray first meets the surface, in units of `direction` and before `end`.
    fn intersect(&self, origin: &Vector3<f64>, direction: &Vector3<f64>, end: f64) -> Option<f64> {
        let towards = self.centre - origin;
        let length_squared = direction.norm_squared();
        let along = towards.dot(direction) / length_squared;
        let miss_squared = (towards - direction * along).norm_squared();
        if miss_squared > self.radius * self.radius {
            return None;
        }
        let o = self.solid_from_world * (origin - self.world_from_solid.translation.vector);
        let d = self.solid_from_world * direction;
        if let Shape::Table { half_size } = self.shape {
            return meet_table(&o, &d, half_size).filter(|&t| t < end);
        }
        let (start, end) = clip(&o, &d, &self.bounds, end)?;
        self.march(&o, &d, start, end)
    }

    /// Sphere tracing (Hart 1996) between two points of a ray.
    fn march(&self, o: &Vector3<f64>, d: &Vector3<f64>, start: f64, end: f64) -> Option<f64> {
        let share = STEP_SHARE / d.norm();
        let mut t = start;
        let mut value = self.shape.implicit(&(o + d * t));
        for _ in 0..200 {
            let step = (value * share).max(NEAR_M * share);
            let next = self.shape.implicit(&(o + d * (t + step)));
            if next < NEAR_M {
                let slope = (next - value) / step;
                let overshoot = if slope < 0.0 { -next / slope } else { 0.0 };
                return Some(t + step + overshoot.clamp(-step, step)).filter(|&t| t <= end);
            }
            (t, value) = (t + step, next);
            if t > end {
                return None;
            }
        }
        None
    }
}

/// A ray's crossing of the table's top.
fn meet_table(o: &Vector3<f64>, d: &Vector3<f64>, half_size: [f64; 2]) -> Option<f64> {
    let t = -o.z / d.z;
    let (x, y) = (o.x + t * d.x, o.y + t * d.y);
    (t > 0.0 && x.abs() <= half_size[0] && y.abs() <= half_size[1]).then_some(t)
}

/// The part of a ray within a box, from its origin up to `end`.
fn clip(
    o: &Vector3<f64>,
    d: &Vector3<f64>,
    bounds: &[Vector3<f64>; 2],
    end: f64,
) -> Option<(f64, f64)> {
    let (mut from, mut to) = (0.0_f64, end);
    for axis in 0..3 {
        let one = (bounds[0][axis] - o[axis]) / d[axis];
        let other = (bounds[1][axis] - o[axis]) / d[axis];
        from = from.max(one.min(other));
        to = to.min(one.max(other));
    }
    (from <= to).then_some((from, to))
}

/// Where a ray met a solid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Hit {
    /// In units of the ray's direction.
    pub(crate) distance: f64,
    /// Which solid.
    pub(crate) solid: usize,
}

/// Solids in the world frame, z up, metres.
#[derive(Clone, Debug)]
pub struct Scene {
    solids: Vec<Solid>,
    /// Which of them is scanned.
    object: usize,
}

impl Scene {
    /// A scene of these solids, of which `object` is the one to scan.
    ///
    /// # Panics
    /// If there is no solid of that number.
    pub fn new(solids: Vec<Solid>, object: usize) -> Self {
        assert!(object < solids.len(), "object {object} is not in the scene");
        Scene { solids, object }
    }

    /// The plaque, leaning back by 25° on a table between boxes of different sizes.
    pub fn plaque() -> Self {
        let lean = 25_f64.to_radians();
        let (sin, cos) = lean.sin_cos();
        // Columns: the plaque's x, y and its front, which looks towards -y and up.
        let axes = Matrix3::from_columns(&[
            Vector3::x(),
            Vector3::new(0.0, sin, cos),
            Vector3::new(0.0, -cos, sin),
        ]);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        let height = medallion::HALF_SIZE[1] * cos + PLAQUE_HALF_DEPTH * sin;
        let pose = Isometry3::from_parts(Translation3::new(0.0, 0.0, height), rotation);
        Scene::with_props(Solid::new(Shape::Plaque, pose, 0.75))
    }

    /// A white sphere of 0.08 m on a table between boxes of different sizes.
    pub fn sphere() -> Self {
        let shape = Shape::Sphere { radius: 0.08 };
        let pose = Isometry3::translation(0.0, 0.0, 0.08);
        Scene::with_props(Solid::new(shape, pose, 0.75))
    }

    /// The sphere with ripples of 0.6 mm, 10 mm long.
    pub fn bumpy_sphere() -> Self {
        let shape = Shape::BumpySphere {
            radius: 0.08,
            amplitude: 0.6e-3,
            wavelength: 10e-3,
        };
        let pose = Isometry3::translation(0.0, 0.0, 0.0806);
        Scene::with_props(Solid::new(shape, pose, 0.75))
    }

    /// A printed wall without end: depth tells nothing of a motion along it.
    pub fn printed_wall() -> Self {
        let wall = Shape::Table {
            half_size: [3.0, 3.0],
        };
        let texture = Texture {
            contrast: 0.6,
            wavelength: 0.09,
        };
        Scene::new(
            vec![Solid::new(wall, Isometry3::identity(), 0.5).with_texture(texture)],
            0,
        )
    }

    /// A printed ball alone on a bare table: depth tells nothing of a turn about its upright axis.
    pub fn printed_ball() -> Self {
        Scene::round(Shape::Sphere { radius: 0.08 }, 0.08)
    }

    /// A printed cylinder alone on a bare table.
    pub fn printed_cylinder() -> Self {
        let shape = Shape::Cylinder {
            radius: 0.06,
            half_height: 0.12,
        };
        Scene::round(shape, 0.12)
    }

    /// A printed solid of revolution, its middle so high above a bare table.
    fn round(shape: Shape, height: f64) -> Self {
        let texture = Texture {
            contrast: 0.6,
            wavelength: 0.06,
        };
        let object = Solid::new(shape, Isometry3::translation(0.0, 0.0, height), 0.5);
        let table = Shape::Table {
            half_size: [1.5, 1.5],
        };
        let table = Solid::new(table, Isometry3::identity(), 0.3);
        Scene::new(vec![object.with_texture(texture), table], 0)
    }

    /// An object on a table between boxes: they tell a tracker where it is when the object alone would not.
    fn with_props(object: Solid) -> Self {
        let table = Shape::Table {
            half_size: [0.75, 0.65],
        };
        let mut solids = vec![object, Solid::new(table, Isometry3::identity(), 0.2)];
        // Middle on the table, turn in degrees, half the size.
        let boxes = [
            (-0.205, 0.075, 20.0, [0.045, 0.035, 0.055]),
            (0.215, -0.045, -35.0, [0.030, 0.050, 0.024]),
            (-0.060, -0.190, 50.0, [0.035, 0.022, 0.014]),
            (0.130, 0.205, 10.0, [0.060, 0.030, 0.085]),
        ];
        for (x, y, turn_deg, half_size) in boxes {
            let turn = Vector3::z() * f64::to_radians(turn_deg);
            let pose = Isometry3::new(Vector3::new(x, y, half_size[2]), turn);
            let radius = 0.004;
            let shape = Shape::RoundedBox { half_size, radius };
            solids.push(Solid::new(shape, pose, 0.4));
        }
        Scene { solids, object: 0 }
    }

    /// Distance to the nearest surface, negative inside; exact on the surface and to first order near it.
    pub fn signed_distance(&self, point_world: &Point3<f64>) -> f64 {
        let solid = &self.solids[self.nearest(point_world)];
        let slope = solid.gradient(&solid.to_local(point_world)).norm();
        solid.implicit(point_world) / slope.max(1e-3)
    }

    /// Outward unit normal of the surface nearest to a point, world frame.
    pub fn normal(&self, point_world: &Point3<f64>) -> Vector3<f64> {
        self.normal_of(self.nearest(point_world), point_world)
    }

    /// IR reflectance of the surface nearest to a point.
    pub fn albedo(&self, point_world: &Point3<f64>) -> f64 {
        self.solids[self.nearest(point_world)].albedo(point_world)
    }

    /// Smallest and largest corner of a box about the object, world frame.
    pub fn object_bounds(&self) -> (Point3<f64>, Point3<f64>) {
        let object = &self.solids[self.object];
        let corners = (0..8).map(|corner| {
            let pick = |axis: usize| object.bounds[corner >> axis & 1][axis];
            object.world_from_solid * Point3::new(pick(0), pick(1), pick(2))
        });
        corners.fold(
            (Point3::from([f64::MAX; 3]), Point3::from([f64::MIN; 3])),
            |(low, high), corner| (low.inf(&corner), high.sup(&corner)),
        )
    }

    /// The first surface along a ray, before `end` (in units of `direction`).
    pub(crate) fn trace(
        &self,
        origin: &Point3<f64>,
        direction: &Vector3<f64>,
        end: f64,
    ) -> Option<Hit> {
        let mut nearest = None;
        let mut end = end;
        for (solid, candidate) in self.solids.iter().enumerate() {
            if let Some(distance) = candidate.intersect(&origin.coords, direction, end) {
                nearest = Some(Hit { distance, solid });
                end = distance;
            }
        }
        nearest
    }

    /// Whether anything stands between two points.
    pub(crate) fn blocked(&self, from: &Point3<f64>, to: &Point3<f64>) -> bool {
        let direction = to - from;
        self.solids
            .iter()
            .any(|solid| solid.intersect(&from.coords, &direction, 1.0).is_some())
    }

    pub(crate) fn albedo_of(&self, solid: usize, point_world: &Point3<f64>) -> f64 {
        self.solids[solid].albedo(point_world)
    }

    pub(crate) fn normal_of(&self, solid: usize, point_world: &Point3<f64>) -> Vector3<f64> {
        let solid = &self.solids[solid];
        let normal = match solid.shape {
            Shape::Table { .. } => Vector3::z(),
            _ => solid.gradient(&solid.to_local(point_world)),
        };
        let normal_world = solid.world_from_solid.rotation * normal;
        normal_world.try_normalize(1e-9).unwrap_or(Vector3::z())
    }

    /// The solid nearest to a point.
    fn nearest(&self, point_world: &Point3<f64>) -> usize {
        let distances = self.solids.iter().map(|solid| solid.implicit(point_world));
        let by_distance = distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        by_distance.map_or(self.object, |(solid, _)| solid)
    }
}
