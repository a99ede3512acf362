//! The lens: rays of pixels, by inverting the Brown–Conrady polynomial.

use depth_camera::Intrinsics;

/// Image points of a ray (x, y, 1), pixels.
fn project(i: &Intrinsics, x: f64, y: f64) -> [f64; 2] {
    let rr = x * x + y * y;
    let stretch = 1.0 + i.k1 * rr + i.k2 * rr.powi(2) + i.k3 * rr.powi(3);
    let bent_x = x * stretch + 2.0 * i.p1 * x * y + i.p2 * (rr + 2.0 * x * x);
    let bent_y = y * stretch + 2.0 * i.p2 * x * y + i.p1 * (rr + 2.0 * y * y);
    [i.fx * bent_x + i.cx, i.fy * bent_y + i.cy]
}

/// The ray (x, y, 1) through a pixel, by Newton's method with central differences; `None` where the lens has none.
pub(crate) fn ray_through(i: &Intrinsics, u: f64, v: f64) -> Option<[f64; 2]> {
    const STEP: f64 = 1e-6;
    let (mut x, mut y) = ((u - i.cx) / i.fx, (v - i.cy) / i.fy);
    for _ in 0..12 {
        let [pu, pv] = project(i, x, y);
        let (du, dv) = (u - pu, v - pv);
        if du.abs() + dv.abs() < 1e-9 {
            return Some([x, y]);
        }
        let [right_u, right_v] = project(i, x + STEP, y);
        let [left_u, left_v] = project(i, x - STEP, y);
        let [below_u, below_v] = project(i, x, y + STEP);
        let [above_u, above_v] = project(i, x, y - STEP);
        let (ux, uy) = (right_u - left_u, below_u - above_u);
        let (vx, vy) = (right_v - left_v, below_v - above_v);
        let determinant = ux * vy - uy * vx;
        // A lens that folds its image back has no ray there.
        if determinant <= 0.0 {
            return None;
        }
        x += 2.0 * STEP * (vy * du - uy * dv) / determinant;
        y += 2.0 * STEP * (ux * dv - vx * du) / determinant;
    }
    let [pu, pv] = project(i, x, y);
    ((u - pu).abs() + (v - pv).abs() < 1e-5).then_some([x, y])
}

/// The same lens with pixels `reduction` times as large.
pub(crate) fn reduced(i: &Intrinsics, reduction: usize) -> Intrinsics {
    let scale = 1.0 / reduction as f64;
    Intrinsics {
        width: i.width / reduction,
        height: i.height / reduction,
        fx: i.fx * scale,
        fy: i.fy * scale,
        cx: (i.cx + 0.5) * scale - 0.5,
        cy: (i.cy + 0.5) * scale - 0.5,
        ..*i
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::intrinsics;
    use depth_camera::Sensor;

    #[test]
    fn every_pixel_has_its_ray() {
        let lens = Intrinsics {
            p1: -0.0042,
            p2: 0.0043,
            ..intrinsics(Sensor::Kinect2)
        };
        for v in (0..lens.height).step_by(53) {
            for u in (0..lens.width).step_by(73) {
                let [x, y] = ray_through(&lens, u as f64, v as f64).unwrap();
                let [pu, pv] = project(&lens, x, y);
                assert!((pu - u as f64).abs() + (pv - v as f64).abs() < 1e-5);
            }
        }
    }
}
