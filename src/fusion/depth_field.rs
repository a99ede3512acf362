//! The slow error field of a Kinect I, measured by the scan itself.
//!
//! The sensor measures some directions too long and others too short, by half a millimetre and more, the same in every frame
//! (Teichman, Miller, Thrun, *Unsupervised intrinsic calibration of depth sensors via SLAM*, RSS 2013). The model, to which
//! every direction has contributed everywhere, does not have that error, so that what a part of the image differs by from
//! the model in all frames is its own. It moves with the camera, and makes tracking believe in less motion than there was.
//! Where a frame lies as a whole is its pose's business: each frame is first moved as fits best, and the field has neither
//! mean nor tilt. It is believed only if the field of one half of the frames explains the other half.
//!
//! Not for a Kinect II: what multipath leaves there moves with the object in the image and is taken for a field. It passes the
//! test on halves (0.38 of the disagreement on the recorded bust), and the surface gets worse, 1.5 to 2.1 mm.

use super::keyframes::Keyframe;
use super::volume::TsdfVolume;
use crate::geometry::{CellGrid, DepthPatch, RayGrid};
use depth_camera::Image;
use nalgebra::{Matrix3, Matrix6, Point3, Vector3, Vector6};
use rayon::prelude::*;

/// How much too long the depth of a Kinect I is, by direction: `offset · z²` metres, for it comes of a disparity that is off
/// by a constant.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthField {
    cells: CellGrid,
    /// One a cell, row by row.
    offsets: Vec<f64>,
}

/// Columns of the field.
const COLUMNS: usize = 32;
/// Pixels between those that are looked at.
const STEP_PX: usize = 4;
/// Most frames that are looked at.
const MAX_FRAMES: usize = 120;
/// Fewer frames cannot be told from their noise.
const MIN_FRAMES: usize = 12;
/// More slanting patches are not looked at: a small turn of the normal is a large range there.
const MIN_COSINE: f64 = 0.5;
/// Fewer patches and a frame's pose takes up all that there is.
const MIN_PATCHES: usize = 60;
/// Distances to the model beyond this are no error of the field, metres.
const MAX_DISTANCE_M: f64 = 0.006;
/// A cell that so many frames have seen is trusted by half.
const HALF_TRUST_FRAMES: f64 = 6.0;
/// Rounds between poses and field.
const ROUNDS: usize = 4;
/// A field that explains less of the other half's disagreement is not believed.
const MIN_EXPLAINED: f64 = 0.02;

/// Share of a field that tracking and fusion do not hide. Fused again without what was measured, `pot-k1` showed 0.56, 0.65, 0.72,
/// 0.77 of the last one in five revisions, as slow parts of a field hide better than fine ones; taken in full, three revisions
/// came as far as six.
const SHOWN_SHARE: f64 = 0.6;

/// A patch of a frame against the model.
struct Sample {
    cell: usize,
    /// How much too long its depth is, over z².
    excess: f64,
    /// Derivative of that by a motion of the camera.
    by_motion: Vector6<f64>,
    weight: f64,
}

impl DepthField {
    /// The field that frames show against the model they were fused into; `None` if it is not to be believed.
    pub(super) fn measure(
        frames: &[Keyframe],
        volume: &TsdfVolume,
        rays: &RayGrid,
    ) -> Option<Self> {
        let every = frames.len().div_ceil(MAX_FRAMES).max(1);
        let frames: Vec<&Keyframe> = frames.iter().step_by(every).collect();
        let i = rays.camera().intrinsics();
        let cells = CellGrid::new(i.width, i.height, COLUMNS);
        let empty = DepthField {
            cells,
            offsets: vec![0.0; cells.n_cells()],
        };
        let samples: Vec<Vec<Sample>> = frames
            .par_iter()
            .map(|frame| empty.samples(frame, volume, rays))
            .filter(|samples| samples.len() >= MIN_PATCHES)
            .collect();
        if samples.len() < MIN_FRAMES {
            return None;
        }
        let (even, odd) = halves(&samples);
        let explained =
            0.5 * (empty.fitted(&even).explains(&odd) + empty.fitted(&odd).explains(&even));
        let all: Vec<&[Sample]> = samples.iter().map(Vec::as_slice).collect();
        let field = empty.fitted(&all);
        tracing::info!(
            frames = all.len(),
            explained,
            rms = field.rms(),
            "depth field: what one half of the frames explains of the other"
        );
        (explained >= MIN_EXPLAINED).then_some(field)
    }

    /// Root mean square of the field, at a metre, metres.
    pub fn rms(&self) -> f64 {
        let squares: f64 = self.offsets.iter().map(|x| x * x).sum();
        (squares / self.offsets.len() as f64).sqrt()
    }

    /// The field of which a scan showed this one.
    pub fn in_full(&self) -> Self {
        DepthField {
            offsets: self.offsets.iter().map(|x| x / SHOWN_SHARE).collect(),
            ..self.clone()
        }
    }

    /// This field and another one that was measured with it taken off.
    pub fn plus(&self, further: &DepthField) -> Self {
        let offsets = self.offsets.iter().zip(&further.offsets);
        DepthField {
            offsets: offsets.map(|(a, b)| a + b).collect(),
            ..self.clone()
        }
    }

    /// A depth image (metres, 0 is none) without the field, bilinear between its cells.
    pub fn corrected(&self, depth_m: &Image<f32>) -> Image<f32> {
        let offsets: Vec<f32> = self.offsets.iter().map(|x| *x as f32).collect();
        let offsets = self.cells.spread(&offsets);
        let pairs = depth_m.data().iter().zip(offsets.data());
        let shorter = pairs.map(|(&z, offset)| match z > 0.0 {
            true => z - offset * z * z,
            false => 0.0,
        });
        Image::from_vec(depth_m.width(), depth_m.height(), shorter.collect())
    }

    fn samples(&self, frame: &Keyframe, volume: &TsdfVolume, rays: &RayGrid) -> Vec<Sample> {
        let depth_m = frame.depth_m();
        let pose = &frame.world_from_camera;
        let sample = |cell: usize| {
            let square = self.cells.square(cell, STEP_PX);
            // An edge is no place to measure.
            let centre = DepthPatch::fit(&depth_m, rays, square)?.centre;
            let (mut sum, mut gradient, mut n) = (0.0, Vector3::zeros(), 0);
            for (u, v) in square.pixels() {
                let z = *depth_m.at(u, v);
                let point = pose * Point3::from((rays.direction(u, v) * z).cast::<f64>());
                let sample = volume.sample_with_gradient(&point.coords.cast());
                if let Some((distance, slope)) = sample.filter(|_| z > 0.0) {
                    sum += f64::from(distance);
                    gradient += slope.cast::<f64>();
                    n += 1;
                }
            }
            let distance = sum / f64::from(n);
            if n < 8 || distance.abs() > MAX_DISTANCE_M {
                return None;
            }
            let normal = pose.rotation.inverse() * gradient.try_normalize(0.0)?;
            let towards = -centre.coords.try_normalize(0.0)?;
            let cosine = normal.dot(&towards);
            if cosine < MIN_COSINE {
                return None;
            }
            // Depth that is too long lies behind the surface, and shortens the signed distance by its cosine.
            let depth_by_distance = -1.0 / (centre.coords.norm() * cosine * centre.z);
            let turn = centre.coords.cross(&normal);
            let motion = Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z);
            Some(Sample {
                cell,
                excess: distance * depth_by_distance,
                by_motion: motion * depth_by_distance,
                weight: cosine * cosine,
            })
        };
        (0..self.offsets.len()).filter_map(sample).collect()
    }

    /// The field that fits frames best, in turn with their poses.
    fn fitted(&self, frames: &[&[Sample]]) -> Self {
        let mut field = self.clone();
        for _ in 0..ROUNDS {
            let mut sums = vec![(0.0, 0.0); field.offsets.len()];
            for samples in frames {
                let motion = field.motion(samples);
                for sample in *samples {
                    let (sum, weights) = &mut sums[sample.cell];
                    *sum += sample.weight * (sample.excess - sample.by_motion.dot(&motion));
                    *weights += sample.weight;
                }
            }
            field.offsets = smoothed(&self.cells, &sums);
            field.level();
        }
        field
    }

    /// How a frame is best moved, the field taken off.
    fn motion(&self, samples: &[Sample]) -> Vector6<f64> {
        let (mut normal_matrix, mut right) = (Matrix6::zeros(), Vector6::zeros());
        for sample in samples {
            let row = sample.by_motion;
            normal_matrix += sample.weight * row * row.transpose();
            right += sample.weight * row * (sample.excess - self.offsets[sample.cell]);
        }
        let damping = 1e-6 * normal_matrix.trace();
        let factor = (normal_matrix + Matrix6::identity() * damping).cholesky();
        factor.map_or_else(Vector6::zeros, |factor| factor.solve(&right))
    }

    /// The share of frames' disagreement with the model that the field explains.
    fn explains(&self, frames: &[&[Sample]]) -> f64 {
        let nothing = DepthField {
            offsets: vec![0.0; self.offsets.len()],
            ..self.clone()
        };
        let left = |field: &DepthField| -> f64 {
            let of_frame = |samples: &&[Sample]| -> f64 {
                let motion = field.motion(samples);
                let squares = samples.iter().map(|sample| {
                    let left =
                        sample.excess - sample.by_motion.dot(&motion) - field.offsets[sample.cell];
                    sample.weight * left * left
                });
                squares.sum()
            };
            frames.iter().map(of_frame).sum()
        };
        1.0 - left(self) / left(&nothing).max(f64::MIN_POSITIVE)
    }

    /// Takes mean and tilt off: they are the pose's.
    fn level(&mut self) {
        let columns = self.cells.columns();
        let row = |cell: usize| Vector3::new(1.0, (cell % columns) as f64, (cell / columns) as f64);
        let (mut moments, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (cell, offset) in self.offsets.iter().enumerate() {
            moments += row(cell) * row(cell).transpose();
            right += row(cell) * *offset;
        }
        if let Some(plane) = moments.cholesky().map(|factor| factor.solve(&right)) {
            for (cell, offset) in self.offsets.iter_mut().enumerate() {
                *offset -= row(cell).dot(&plane);
            }
        }
    }
}

/// Frames by turns.
fn halves(samples: &[Vec<Sample>]) -> (Vec<&[Sample]>, Vec<&[Sample]>) {
    let every_second = |first: usize| samples.iter().skip(first).step_by(2).map(Vec::as_slice);
    (every_second(0).collect(), every_second(1).collect())
}

/// Means over three by three cells, which fade to nothing where little was seen.
fn smoothed(cells: &CellGrid, sums: &[(f64, f64)]) -> Vec<f64> {
    let (columns, rows) = (cells.columns(), cells.rows());
    let at = |column: usize, row: usize| {
        let (mut sum, mut weights) = (0.0, HALF_TRUST_FRAMES);
        for y in row.saturating_sub(1)..(row + 2).min(rows) {
            for x in column.saturating_sub(1)..(column + 2).min(columns) {
                let nearness =
                    [1.0, 0.5][usize::from(x != column)] * [1.0, 0.5][usize::from(y != row)];
                let (part, weight) = sums[y * columns + x];
                sum += nearness * part;
                weights += nearness * weight;
            }
        }
        sum / weights
    };
    (0..rows)
        .flat_map(|row| (0..columns).map(move |column| (column, row)))
        .map(|(column, row)| at(column, row))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fusion::packed_depth::PackedDepth;
    use crate::fusion::tests::{frames, small_params};
    use crate::fusion::{DepthNoise, Fusion};
    use crate::geometry::CameraModel;
    use depth_camera::Sensor;

    /// What a made-up sensor gets wrong at a ray, over z².
    fn error_at(x: f64, y: f64) -> f64 {
        0.012 * (x * x + y * y - 0.1) + 0.004 * x * y
    }

    /// The model of true depth, and the frames with an error of `scale` times [`error_at`] at their true poses.
    fn seen(scale: f64) -> (Fusion, Vec<Keyframe>, CameraModel) {
        let (frames, truth, camera) = frames(24);
        let rays = RayGrid::new(camera);
        let noise = DepthNoise::of_sensor(Sensor::Kinect2);
        let mut fusion = Fusion::new(camera, noise, small_params());
        let mut keyframes = Vec::new();
        for (frame, pose) in frames.iter().zip(&truth) {
            let depth = frame.depth.as_ref().expect("Kinect II");
            fusion.fuse_at(depth, frame.device_time_secs, pose);
            let pairs = depth.data().iter().zip(rays.rays().data());
            let wrong: Vec<f32> = pairs
                .map(|(&z, &[x, y])| {
                    let error = scale * error_at(f64::from(x), f64::from(y));
                    z * (1.0 + error as f32 * z)
                })
                .collect();
            keyframes.push(Keyframe {
                depth: PackedDepth::pack(&wrong, depth.width(), 1.5),
                time_secs: frame.device_time_secs,
                world_from_camera: *pose,
                stretch: 0,
            });
        }
        (fusion, keyframes, camera)
    }

    #[test]
    fn a_bowl_is_found_where_the_image_shows_a_surface() {
        let (fusion, keyframes, camera) = seen(1.0);
        let rays = RayGrid::new(camera);
        let field = DepthField::measure(&keyframes, &fusion.volume, &rays).expect("a field");
        let nothing = DepthField {
            offsets: vec![0.0; field.offsets.len()],
            ..field.clone()
        };
        // Mean square of what a field leaves of a frame that is moved as fits best.
        let left = |frame: &Keyframe, field: &DepthField| {
            let samples = field.samples(frame, &fusion.volume, &rays);
            let motion = field.motion(&samples);
            let squares = samples.iter().map(|sample| {
                let moved = sample.by_motion.dot(&motion);
                (sample.excess - moved - field.offsets[sample.cell]).powi(2)
            });
            squares.sum::<f64>() / samples.len() as f64
        };
        let (_, without, _) = seen(0.0);
        let noise = left(&without[12], &nothing);
        let (before, after) = (left(&keyframes[12], &nothing), left(&keyframes[12], &field));
        let share = (after - noise) / (before - noise);
        assert!(
            before > 2.0 * noise && share < 0.3,
            "{before} -> {after}, noise {noise}"
        );
    }

    #[test]
    fn frames_without_a_field_show_none() {
        let (fusion, keyframes, camera) = seen(0.0);
        let rays = RayGrid::new(camera);
        let field = DepthField::measure(&keyframes, &fusion.volume, &rays);
        assert!(field.is_none_or(|field| field.rms() < 3e-4));
    }
}
