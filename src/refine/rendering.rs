//! What a view shows of a mesh, integrated over its pixels as the sensor does it.
//!
//! A prediction sampled at pixel centres prefers surfaces that are too smooth, since the image is blurred by the pixels and
//! the prediction is not. Here every pixel is the mean of the facets that the view sees in it. Facets are cut into equal parts,
//! each of which counts for the pixel that its middle falls on, which needs no search for what is nearest.

use super::gaze::{Gaze, Surfels};
use super::sites::Sites;
use super::view::View;
use crate::geometry::TriMesh;
use crate::geometry::lanes::LANES;
use crate::shading::sharpen;
use depth_camera::Image;
use rayon::prelude::*;

/// What views would show of a surface as it is, their pixels' blur taken off as it is of what they do show.
///
/// Where it differs from the prediction at a site, taking off the blur has missed something: relief narrower than a few pixels, and
/// borders between albedos.
pub struct Rendered<'a> {
    /// One a view, if it sees anything.
    images: Vec<Option<Image<f32>>>,
    /// Albedo of each site, which was rendered.
    pub albedo: &'a [f64],
}

impl<'a> Rendered<'a> {
    /// Renders a mesh as the views that see its sites would show it.
    pub fn new(mesh: &TriMesh, sites: &Sites, views: &[View], albedo: &'a [f64]) -> Self {
        let seeing = sites.visible.iter().fold(0, |all, visible| all | visible);
        let views = views.par_iter().with_max_len(1).enumerate();
        let image = |(index, view): (usize, &View)| {
            let sees = seeing >> index & 1 == 1;
            sees.then(|| sharpen(&render(view, mesh, (sites, index), albedo)))
        };
        Rendered {
            images: views.map(image).collect(),
            albedo,
        }
    }

    /// What a view shows, by its number.
    pub fn image(&self, index: usize) -> Option<&Image<f32>> {
        self.images[index].as_ref()
    }
}

/// Parts of facets that a pixel has at least.
const PARTS: f32 = 12.0;
/// A facet has no more than this squared.
const MAX_CUTS: f32 = 16.0;
/// Share of a pixel's area that facets have to cover.
const COVERED: f32 = 0.75;

/// Linear intensity that a view would show, NaN where a pixel is not covered by facets that it sees. `sites` are the mesh's, with
/// an albedo each, and `index` is the view's number in them. A facet is as bright as it is predicted, or as its corners are in the
/// mean.
pub fn render(
    view: &View,
    mesh: &TriMesh,
    (sites, index): (&Sites, usize),
    albedo: &[f64],
) -> Image<f32> {
    let gaze = Gaze::new(view);
    let corners = gaze.pixels_of(&mesh.vertices);
    let (width, height) = (view.linear().value.width(), view.linear().value.height());
    let mut sums = Image::filled(width, height, Sum::default());
    let mut intensities = vec![f64::NAN; sites.points.len()];
    for seen in sites.of_view(index).chunks(LANES) {
        let mut surfels = Surfels::new(sites.gloss.is_matte());
        for (lane, &site) in seen.iter().enumerate() {
            sites.write(site as usize, &mut surfels, lane);
        }
        let unit = gaze.predictions(&surfels);
        for (&site, unit) in seen.iter().zip(unit) {
            intensities[site as usize] = albedo[site as usize] * f64::from(unit);
        }
    }
    for (face, vertices) in mesh.faces.iter().enumerate() {
        let intensity = sites.at_face(mesh, &intensities, face);
        if !intensity.is_nan() {
            let corners = vertices.map(|vertex| corners[vertex as usize]);
            spread(&mut sums, corners, intensity as f32);
        }
    }
    sums.map(|sum| match sum.area_px2 >= COVERED {
        true => sum.intensity / sum.area_px2,
        false => f32::NAN,
    })
}

/// What was seen in a pixel.
#[derive(Clone, Copy, Default)]
struct Sum {
    /// Intensity times area.
    intensity: f32,
    /// Area, square pixels.
    area_px2: f32,
}

/// Adds a facet, given by its corners on the image, part by part to the pixels; one with a corner outside is left out.
fn spread(sums: &mut Image<Sum>, [a, b, c]: [[f32; 2]; 3], intensity: f32) {
    let side = |p: [f32; 2]| [p[0] - a[0], p[1] - a[1]];
    let (ab, ac) = (side(b), side(c));
    let area_px2 = 0.5 * (ab[0] * ac[1] - ab[1] * ac[0]).abs();
    if area_px2.is_nan() {
        return;
    }
    let cuts = (PARTS * area_px2).sqrt().ceil().clamp(1.0, MAX_CUTS);
    let area_px2 = area_px2 / (cuts * cuts);
    let width = sums.width();
    let mut add = |i: f32, j: f32| {
        let (s, t) = (i / cuts, j / cuts);
        let [u, v] = [0, 1].map(|axis| a[axis] + s * ab[axis] + t * ac[axis]);
        let sum = &mut sums.data_mut()[(v + 0.5) as usize * width + (u + 0.5) as usize];
        sum.intensity += area_px2 * intensity;
        sum.area_px2 += area_px2;
    };
    let cuts = cuts as usize;
    for i in 0..cuts {
        for j in 0..cuts - i {
            let (i, j) = (i as f32, j as f32);
            // Parts that point as the facet does, and those between them.
            add(i + 1.0 / 3.0, j + 1.0 / 3.0);
            if i + j + 1.0 < cuts as f32 {
                add(i + 2.0 / 3.0, j + 2.0 / 3.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::observations::Observations;
    use super::super::scenes::{ALBEDO, RippledPlane, calibration, optics, poses, rays, views_of};
    use super::super::sites::SiteKind;
    use super::*;
    use crate::snapshot::ShadingSnapshot;

    const FLAT: RippledPlane = RippledPlane { amplitude_m: 0.0 };

    fn snapshot(of: &RippledPlane) -> ShadingSnapshot {
        let (rays, calibration) = (rays(), calibration());
        of.snapshot(&optics(&rays, &calibration), &poses(0.0)[0])
    }

    fn view_of(snapshot: ShadingSnapshot, mesh: &TriMesh) -> [View; 1] {
        let (rays, calibration) = (rays(), calibration());
        let views = views_of(&[snapshot], mesh, &optics(&rays, &calibration));
        views.try_into().expect("one")
    }

    #[test]
    fn a_surface_shows_what_was_seen_of_it_and_nothing_beyond_its_rim() {
        let rippled = RippledPlane {
            amplitude_m: 0.0002,
        };
        for edge_m in [0.0006, 0.0013, 0.003] {
            let mesh = rippled.mesh(edge_m);
            let view = view_of(snapshot(&rippled), &mesh);
            let sites = Sites::new(SiteKind::Face, &mesh, &view, 1);
            let albedo = vec![ALBEDO; mesh.faces.len()];
            let shown = render(&view[0], &mesh, (&sites, 0), &albedo);
            let seen = &view[0].linear().integrated;
            let pairs = shown.data().iter().zip(seen.data());
            let errors: Vec<f32> = pairs
                .filter(|(shown, _)| !shown.is_nan())
                .map(|(shown, seen)| shown / seen - 1.0)
                .collect();
            // 80 mm are 66 pixels, of which the outermost are not used.
            assert!(errors.len() > 55 * 55 && errors.len() < 70 * 70);
            let square: f32 = errors.iter().map(|error| error * error).sum();
            let rms = (square / errors.len() as f32).sqrt();
            // A facet of 3 mm cuts off ripples of 12.
            assert!(rms < if edge_m < 0.002 { 0.004 } else { 0.02 }, "{rms}");
        }
    }

    #[test]
    fn what_pixels_mix_at_a_border_is_taken_off() {
        const DARKER: f64 = 0.7;
        let mesh = FLAT.mesh(0.0006);
        let (camera, gamma) = (*rays().camera(), calibration().gamma);
        let mut snapshot = snapshot(&FLAT);
        let width = snapshot.ir_counts.width();
        let pixels = snapshot.ir_counts.data_mut().iter_mut().enumerate();
        for (pixel, counts) in pixels {
            let (u, v) = ((pixel % width) as f64, (pixel / width) as f64);
            let side = |aside: f64| camera.unproject(u + aside, v).map(|ray| ray.x);
            let (Some(left), Some(right)) = (side(-0.5), side(0.5)) else {
                continue;
            };
            let dark = (-left / (right - left)).clamp(0.0, 1.0);
            let mean = dark * DARKER + 1.0 - dark;
            *counts = (f64::from(*counts) * mean.powf(gamma)) as f32;
        }
        let view = view_of(snapshot, &mesh);
        let sites = Sites::new(SiteKind::Face, &mesh, &view, 1);
        let albedo: Vec<f64> = (0..mesh.faces.len())
            .map(|face| match sites.points[face].x < 0.0 {
                true => DARKER * ALBEDO,
                false => ALBEDO,
            })
            .collect();
        let rms = |rendered: Option<&Rendered>| {
            let observations = Observations::new(&sites, &view, None, rendered);
            let beside = (0..mesh.faces.len()).filter(|&face| sites.points[face].x.abs() < 0.002);
            let mut squares = Vec::new();
            for face in beside {
                for seen in observations.of(face) {
                    let residual = seen.residual(&sites.normals[face], albedo[face]);
                    squares.push(residual.expect("lit").powi(2));
                }
            }
            assert!(squares.len() > 500);
            (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
        };
        let mixed = rms(None);
        let taken_off = rms(Some(&Rendered::new(&mesh, &sites, &view, &albedo)));
        assert!(
            mixed > 0.5 && taken_off < 0.5 * mixed,
            "{mixed} {taken_off}"
        );
    }
}
