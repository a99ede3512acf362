//! The pictures of a report: the surface before and after, and what the sensor saw.

use super::{fusion_stage::FusedScan, refine_stage::RefineSummary};
use crate::{
    export::{
        MeanView, PhongParams, PictureSize, PictureView, ReportPictures, SeenSurface, SurfaceField,
        phong, three_views,
    },
    geometry::TriMesh,
    refine::Refinement,
    robust::quantile,
    snapshot::ShadingSnapshot,
};
use depth_camera::Image;
use rayon::prelude::*;

/// Shading images shown at most; they are spread over the scan.
const MAX_THUMBNAILS: usize = 12;
/// This share of the pixels of an image, and of the albedos of a surface, is shown as the brightest at most, so that a highlight does
/// not darken the rest.
const BRIGHT_SHARE: f64 = 0.005;

/// Draws all pictures of a scan.
pub fn draw(scan: &FusedScan, refined: &RefineSummary) -> ReportPictures {
    let shown = refined.object.as_ref().unwrap_or(&scan.base);
    let mean = MeanView::from_poses(&scan.world_from_cameras);
    let views = three_views(shown, &mean, PictureSize::default());
    let draw_all = |mesh: &TriMesh| {
        let normals = mesh.vertex_normals();
        let draw = |view: &PictureView| phong(mesh, &normals, view, &PhongParams::default());
        views.par_iter().flatten().map(draw).collect::<Vec<_>>()
    };
    let draw_refined = || {
        let refinement = refined.refinement.iter();
        refinement
            .flat_map(|refinement| draw_all(&refinement.mesh))
            .collect()
    };
    let draw_fields = || match (&views, &refined.refinement) {
        (Some([front, ..]), Some(refinement)) => fields(refinement, front),
        _ => Vec::new(),
    };
    let shading = scan.snapshots.as_ref();
    let shading = shading.map_or(&[][..], |snapshots| &snapshots.accepted);
    let every = shading.len().div_ceil(MAX_THUMBNAILS).max(1);
    let draw_thumbnails = || shading.par_iter().step_by(every).map(thumbnail).collect();
    let surfaces = || rayon::join(|| draw_all(shown), draw_refined);
    let ((base, refined), (fields, thumbnails)) =
        rayon::join(surfaces, || rayon::join(draw_fields, draw_thumbnails));
    ReportPictures {
        base,
        refined,
        thumbnails,
        depth_thumbnail: scan.last_depth.as_ref().map(depth_as_grey),
        fields,
    }
}

/// What is known of a refined mesh.
fn fields(refinement: &Refinement, front: &PictureView) -> Vec<SurfaceField> {
    let evidence = &refinement.evidence;
    let n_views: Vec<f64> = evidence.n_views.iter().copied().map(f64::from).collect();
    let most_views = n_views.iter().copied().fold(0.0, f64::max);
    let high_sigma_m = evidence.summary().high_sigma_m;
    let fields: [(_, &str, &[f64], f64, f64); 5] = [
        (
            "Albedo",
            "That of the label to which the surface was given, times what a place of its own is brighter or darker by; \
             the brightest in two hundred share a colour.",
            &refinement.albedo,
            high_level(refinement.albedo.clone()).unwrap_or(1.0),
            1.0,
        ),
        (
            "Sigma, mm",
            "Standard deviation of the displacement.",
            &evidence.sigma_m,
            1.2 * high_sigma_m,
            1000.0,
        ),
        (
            "Confidence",
            "Share of the displacement's variance that the images took away.",
            &evidence.confidence,
            1.0,
            1.0,
        ),
        (
            "Coverage",
            "Share of what is known of the worst known tilt that the images say; dark means the prior rules.",
            &evidence.coverage,
            1.0,
            1.0,
        ),
        (
            "Images",
            "How many shading images show the surface; where there is none it is as it was fused, but for some 8 mm beside what they show.",
            &n_views,
            most_views,
            1.0,
        ),
    ];
    let seen = SeenSurface::new(&refinement.mesh, front);
    let draw = |(title, caption, values, high, factor): (_, &str, &[f64], f64, f64)| SurfaceField {
        title,
        caption: caption.to_owned(),
        values: seen.draw(values),
        range: [0.0, high],
        factor,
    };
    let mut drawn: Vec<SurfaceField> = fields.into_par_iter().map(draw).collect();
    let n_labels = refinement.materials.len();
    if n_labels > 1 {
        drawn.insert(1, labels(seen.draw_labels(&refinement.labels), n_labels));
    }
    drawn
}

/// Which material the surface was given to, where there are several.
fn labels(values: Image<f32>, n_labels: usize) -> SurfaceField {
    SurfaceField {
        title: "Label",
        caption: "Number of the label to which the surface was given, as listed with its albedo."
            .to_owned(),
        values,
        range: [0.0, (n_labels - 1) as f64],
        factor: 1.0,
    }
}

fn thumbnail(snapshot: &ShadingSnapshot) -> (String, Image<u8>) {
    let caption = format!(
        "Infrared, frame {}, {:.2} s",
        snapshot.frame_id, snapshot.device_time_secs
    );
    let ir = &snapshot.ir_counts;
    let white = high_level(ir.data().iter().copied().map(f64::from).collect());
    let white = white.map_or(1.0, |white| white.max(1.0)) as f32;
    let grey = |&counts: &f32| (255.0 * (counts / white).clamp(0.0, 1.0)) as u8;
    (caption, ir.map(grey))
}

/// The value that no more than [`BRIGHT_SHARE`] of all exceed; `None` of none.
fn high_level(mut values: Vec<f64>) -> Option<f64> {
    quantile(&mut values, 1.0 - BRIGHT_SHARE)
}

/// Near is bright, no measurement black.
fn depth_as_grey(depth: &Image<f32>) -> Image<u8> {
    let valid = || depth.data().iter().copied().filter(|&z| z > 0.0);
    let near = valid().fold(f32::INFINITY, f32::min);
    let far = valid().fold(0.0, f32::max);
    let range = (far - near).max(1e-3);
    depth.map(|&z| {
        if z > 0.0 {
            (255.0 - 200.0 * (z - near) / range) as u8
        } else {
            0
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_few_bright_values_do_not_set_the_scale() {
        let level = |n: usize, n_bright: usize| {
            let bright = (0..n_bright).map(|_| 100.0);
            high_level((0..n).map(|_| 1.0).chain(bright).collect())
        };
        assert_eq!(level(0, 0), None);
        assert_eq!(level(1, 0), Some(1.0));
        assert_eq!((level(996, 4), level(980, 20)), (Some(1.0), Some(100.0)));
    }
}
