//! Depth that was computed with the rays of its image upside down.
//!
//! A Kinect II measures how far a surface is along the ray of each pixel, and depth is that over the ray's length. libfreenect2's CPU
//! and OpenGL decoders take the rays of the rows upside down, which bends depth the more the farther the principal point lies from the
//! middle row: by 54 mm from the top row to the bottom one at a metre, for 10 pixels. What is decoded here is not bent so; recordings
//! that others have decoded may be.

use crate::geometry::RayGrid;
use depth_camera::Image;
use std::fmt;

/// How the depth of a scan was computed, where that is not by the rays of its pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WrongRays {
    /// With those of the image upside down, as libfreenect2's CPU and OpenGL decoders do.
    UpsideDown,
    /// With the right ones, after which `fusion.rays_upside_down` bent it.
    PutRightInVain,
}

impl fmt::Display for WrongRays {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            WrongRays::UpsideDown => {
                "depth was computed with the rays of its image upside down, as libfreenect2's CPU and OpenGL decoders do, and was put \
                 right; `fusion.rays_upside_down = true` lets tracking know"
            }
            WrongRays::PutRightInVain => {
                "depth was computed with the right rays and bent by `fusion.rays_upside_down = true`, and was put right; false lets \
                 tracking know"
            }
        })
    }
}

/// Depth whose rays were upside down, and which is put right.
#[derive(Clone, Debug)]
pub(super) struct RayOrder {
    /// By how much depth becomes longer, pixel by pixel; 1 where the lens has no ray.
    factors: Image<f32>,
}

/// A bend of no more than this share of depth anywhere cannot be told: 3 mm at a metre.
const MIN_BEND: f32 = 0.003;

impl RayOrder {
    /// That of the rays of an image whose depth was computed with them upside down.
    pub(super) fn upside_down(rays: &RayGrid) -> Self {
        let (width, height) = (rays.rays().width(), rays.rays().height());
        let length = |u: usize, v: usize| rays.direction(u, v).norm();
        let pixels = (0..height).flat_map(|v| (0..width).map(move |u| (u, v)));
        let factors = pixels.map(|(u, v)| {
            let factor = length(u, height - 1 - v) / length(u, v);
            if factor.is_finite() { factor } else { 1.0 }
        });
        RayOrder {
            factors: Image::from_vec(width, height, factors.collect()),
        }
    }

    /// What undoes it, where there was nothing to put right.
    pub(super) fn undone(&self) -> Self {
        RayOrder {
            factors: self.factors.map(|factor| factor.recip()),
        }
    }

    /// A depth image (metres, 0 is none) put right.
    pub(super) fn righted(&self, depth_m: &Image<f32>) -> Image<f32> {
        let pairs = depth_m.data().iter().zip(self.factors.data());
        let righted = pairs.map(|(z, factor)| z * factor);
        Image::from_vec(depth_m.width(), depth_m.height(), righted.collect())
    }

    /// Whether it bends depth by enough to be told.
    pub(super) fn shows(&self) -> bool {
        let bends = self.factors.data().iter();
        bends.fold(0.0f32, |most, factor| most.max((factor - 1.0).abs())) >= MIN_BEND
    }
}
