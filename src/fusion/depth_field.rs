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

use super::frame_patches::{self, MotionFit, Patch};
use super::keyframes::Keyframe;
use super::volume::TsdfVolume;
use crate::geometry::{CellGrid, RayGrid};
use depth_camera::Image;
use nalgebra::{Matrix3, Vector3, Vector6};

/// How much too long the depth of a Kinect I is, by direction: `offset · z²` metres, for it comes of a disparity that is off
/// by a constant.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthField {
    cells: CellGrid,
    /// One a cell, row by row.
    offsets: Vec<f64>,
}

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

impl DepthField {
    /// The field that frames show against the model they were fused into; `None` if it is not to be believed.
    pub(super) fn measure(
        frames: &[Keyframe],
        volume: &TsdfVolume,
        rays: &RayGrid,
    ) -> Option<Self> {
        let cells = frame_patches::cells(rays);
        let patches = frame_patches::of_frames(frames, volume, rays, &cells, MAX_DISTANCE_M)?;
        let patches: Vec<&[Patch]> = patches.iter().map(|(_, patches)| &patches[..]).collect();
        let empty = DepthField {
            cells,
            offsets: vec![0.0; cells.n_cells()],
        };
        let (even, odd) = frame_patches::halves(&patches);
        let explained =
            0.5 * (empty.fitted(&even).explains(&odd) + empty.fitted(&odd).explains(&even));
        let field = empty.fitted(&patches);
        tracing::info!(
            frames = patches.len(),
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

    /// The field that fits frames best, in turn with their poses.
    fn fitted(&self, frames: &[&[Patch]]) -> Self {
        let mut field = self.clone();
        for _ in 0..ROUNDS {
            let mut sums = vec![(0.0, 0.0); field.offsets.len()];
            for patches in frames {
                let motion = field.motion(patches);
                for patch in *patches {
                    let (sum, weights) = &mut sums[patch.cell];
                    *sum += patch.weight * (patch.excess - patch.by_motion.dot(&motion));
                    *weights += patch.weight;
                }
            }
            field.offsets = smoothed(&self.cells, &sums);
            field.level();
        }
        field
    }

    /// How a frame is best moved, the field taken off.
    fn motion(&self, patches: &[Patch]) -> Vector6<f64> {
        MotionFit::new(patches).explaining(|patch| patch.excess - self.offsets[patch.cell])
    }

    /// The share of frames' disagreement with the model that the field explains.
    fn explains(&self, frames: &[&[Patch]]) -> f64 {
        let nothing = DepthField {
            offsets: vec![0.0; self.offsets.len()],
            ..self.clone()
        };
        let left = |field: &DepthField| -> f64 {
            let of_frame = |patches: &&[Patch]| -> f64 {
                let motion = field.motion(patches);
                let squares = patches.iter().map(|patch| {
                    let left =
                        patch.excess - patch.by_motion.dot(&motion) - field.offsets[patch.cell];
                    patch.weight * left * left
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

/// Means over three by three cells, which fade to nothing where little was seen.
fn smoothed(cells: &CellGrid, sums: &[(f64, f64)]) -> Vec<f64> {
    let place = |cell: usize| [cell % cells.columns(), cell / cells.columns()];
    let nearness = |cell: usize, other: usize| -> f64 {
        let [[column, row], [x, y]] = [place(cell), place(other)];
        [1.0, 0.5][usize::from(x != column)] * [1.0, 0.5][usize::from(y != row)]
    };
    let at = |cell: usize| {
        let (mut sum, mut weights) = (0.0, HALF_TRUST_FRAMES);
        for other in cells.beside(cell, 1) {
            let (part, weight) = sums[other];
            let nearness = nearness(cell, other);
            sum += nearness * part;
            weights += nearness * weight;
        }
        sum / weights
    };
    (0..cells.n_cells()).map(at).collect()
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
                depth: PackedDepth::pack(&wrong, depth.width(), 1.5, &mut Vec::new()),
                time_secs: frame.device_time_secs,
                world_from_camera: *pose,
                given: None,
                stretch: 0,
                n_frames: 1,
            });
        }
        (fusion, keyframes, camera)
    }

    #[test]
    fn a_bowl_is_found_where_the_image_shows_a_surface() {
        let (fusion, keyframes, camera) = seen(1.0);
        let rays = RayGrid::new(camera);
        let field = DepthField::measure(&keyframes, &fusion.fused.volume, &rays).expect("a field");
        let nothing = DepthField {
            offsets: vec![0.0; field.offsets.len()],
            ..field.clone()
        };
        // Mean square of what a field leaves of a frame that is moved as fits best.
        let left = |frame: &Keyframe, field: &DepthField| {
            let (volume, cells) = (&fusion.fused.volume, &field.cells);
            let patches = frame_patches::of_frame(frame, volume, &rays, cells, MAX_DISTANCE_M);
            let motion = field.motion(&patches);
            let squares = patches.iter().map(|patch| {
                let moved = patch.by_motion.dot(&motion);
                (patch.excess - moved - field.offsets[patch.cell]).powi(2)
            });
            squares.sum::<f64>() / patches.len() as f64
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
        let field = DepthField::measure(&keyframes, &fusion.fused.volume, &rays);
        assert!(field.is_none_or(|field| field.rms() < 3e-4));
    }
}
