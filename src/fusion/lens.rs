//! Projection for kernels that work on many points at once.
//!
//! The kernels of this module's siblings are plain loops over arrays, which the compiler turns into vector code once for
//! each instruction set that [`pulp::Arch`] knows; the processor's own is chosen at run time. Every operation is one of
//! IEEE 754 and none is fused or reordered, so that all of them give the same bits.

use crate::geometry::CameraModel;

/// [`CameraModel::project`] in single precision, rounded to the nearest pixel; off by 10⁻⁴ pixels at most.
#[derive(Clone, Copy, Debug)]
pub struct Lens {
    focal: [f32; 2],
    centre: [f32; 2],
    radial: [f32; 3],
    tangential: [f32; 2],
    max_radius_squared: f32,
    /// Centres of the last column and row.
    last: [f32; 2],
    stride: f32,
    n_pixels: u32,
}

/// 2²³: adding it to a smaller number that is not negative leaves the number, rounded, in the low bits.
const ROUND: f32 = 8_388_608.0;
const ROUND_MASK: u32 = 0x7F_FFFF;

impl Lens {
    /// The lens of a camera.
    ///
    /// # Panics
    /// For images of 8 million pixels and more.
    pub fn new(camera: &CameraModel) -> Self {
        let i = camera.intrinsics();
        let n_pixels = i.width * i.height;
        assert!(n_pixels < ROUND as usize, "{n_pixels} pixels are too many");
        Lens {
            focal: [i.fx as f32, i.fy as f32],
            centre: [i.cx as f32, i.cy as f32],
            radial: [i.k1 as f32, i.k2 as f32, i.k3 as f32],
            tangential: [i.p1 as f32, i.p2 as f32],
            max_radius_squared: camera.max_radius_squared() as f32,
            last: [i.width as f32 - 1.0, i.height as f32 - 1.0],
            stride: i.width as f32,
            n_pixels: n_pixels as u32,
        }
    }

    /// Row-major index of the pixel nearest to a point in the camera frame (m); the number of pixels where there is none.
    #[inline(always)]
    pub fn pixel_index(&self, [x, y, z]: [f32; 3]) -> u32 {
        let inv_z = 1.0 / z;
        let (x, y) = (x * inv_z, y * inv_z);
        let ([k1, k2, k3], [p1, p2]) = (self.radial, self.tangential);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let xy2 = 2.0 * x * y;
        let xd = x * radial + (p1 * xy2 + p2 * (r2 + 2.0 * x * x));
        let yd = y * radial + (p1 * (r2 + 2.0 * y * y) + p2 * xy2);
        let u = self.focal[0] * xd + self.centre[0];
        let v = self.focal[1] * yd + self.centre[1];
        let seen = (z > 1e-6)
            & (r2 <= self.max_radius_squared)
            & (u >= 0.0)
            & (v >= 0.0)
            & (u <= self.last[0])
            & (v <= self.last[1]);
        let (column, row) = ((u + ROUND) - ROUND, (v + ROUND) - ROUND);
        let index = round_bits(row * self.stride + column);
        if seen { index } else { self.n_pixels }
    }
}

/// The integer nearest to a number from 0 to 2²³.
#[inline(always)]
pub fn round_bits(x: f32) -> u32 {
    (x + ROUND).to_bits() & ROUND_MASK
}

/// The instruction sets that this processor has.
#[cfg(test)]
pub(crate) fn arch_levels() -> Vec<pulp::Arch> {
    use pulp::Arch;
    let mut levels = vec![Arch::Scalar];
    #[cfg(target_arch = "x86_64")]
    {
        levels.extend(pulp::x86::V3::try_new().map(Arch::V3));
        levels.extend(pulp::x86::V4::try_new().map(Arch::V4));
    }
    levels
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::tests::distorted_camera;
    use nalgebra::Point3;

    #[test]
    fn the_index_is_that_of_the_exact_projection() {
        let camera = distorted_camera();
        let lens = Lens::new(&camera);
        let (width, height) = (512.0, 424.0);
        let mut n_seen = 0;
        for step in 0..20_000 {
            let angle = f64::from(step) * 0.1;
            let radius = f64::from(step) * 6e-5;
            let point = Point3::new(0.7 * radius * angle.cos(), 0.7 * radius * angle.sin(), 0.7);
            let pixel = camera.project(&point).filter(|p| camera.contains(p, 0.0));
            let index = lens.pixel_index([point.x, point.y, point.z].map(|x| x as f32));
            let Some(pixel) = pixel else {
                // Within rounding of the border either answer is right.
                let near = index < 512 * 424 && camera.project(&point).is_some();
                assert!(index == 512 * 424 || near);
                continue;
            };
            let off = [pixel.x, pixel.y].map(|x| (x - x.floor() - 0.5).abs());
            let border = pixel.x < 1e-3
                || pixel.y < 1e-3
                || pixel.x > width - 1.001
                || pixel.y > height - 1.001;
            if border || off.iter().any(|&off| off < 1e-3) {
                continue;
            }
            n_seen += 1;
            let expected = pixel.y.round() * width + pixel.x.round();
            assert_eq!(f64::from(index), expected);
        }
        assert!(n_seen > 5000);
    }

    #[test]
    fn what_is_behind_the_camera_has_no_pixel() {
        let lens = Lens::new(&distorted_camera());
        for z in [0.0, -1.0, f32::NAN] {
            assert_eq!(lens.pixel_index([0.01, 0.0, z]), 512 * 424);
        }
    }
}
