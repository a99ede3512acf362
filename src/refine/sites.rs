//! Where the surface is compared with the images: one site a facet, at its centroid, or one a vertex.

use super::gaze::{Gaze, Surfels, set_lane};
use super::site_gloss::SiteGloss;
use super::surface::unit_normal;
use super::tiles::TILE;
use super::view::{Look, Sample, View};
use crate::geometry::TriMesh;
use crate::geometry::lanes::LANES;
use nalgebra::{Point3, Vector3, Vector4};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// What sites are at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SiteKind {
    /// One a facet, at its centroid.
    Face,
    /// One a vertex, as in the paper, with the mean normal of the facets round it by their areas.
    #[default]
    Vertex,
}

/// The sites of a mesh and the views that see them.
#[derive(Clone)]
pub struct Sites {
    /// What they are at.
    pub kind: SiteKind,
    /// Centroid of each face, or each vertex.
    pub points: Vec<Point3<f64>>,
    /// Unit normal of each; zero where it has none.
    pub normals: Vec<Vector3<f64>>,
    /// Area of each, m²; a vertex has a third of the faces round it.
    pub areas_m2: Vec<f64>,
    /// Bit k of a site is set where view k sees it.
    pub visible: Vec<ViewSet>,
    /// How glossy each is.
    pub gloss: SiteGloss,
}

/// How well a view's image is predicted.
pub struct ViewError {
    /// Sites that the view sees.
    pub n_sites: usize,
    /// Root mean square of observed less predicted linear intensity, as a share of the mean observed one.
    pub rmse: f64,
}

/// A vertex has no normal where the faces round it are folded together, so that their area vectors sum to less of their area.
const MIN_FLATNESS: f64 = 0.4;

/// A set of views: bit k stands for view k.
pub type ViewSet = u128;

impl Sites {
    /// Finds the sites of a mesh and who of a set of views sees them.
    pub fn new(kind: SiteKind, mesh: &TriMesh, views: &[View], set: ViewSet) -> Sites {
        Sites::unseen(kind, mesh).seen_by(views, set)
    }

    /// The sites of a mesh that nobody looks at.
    pub fn unseen(kind: SiteKind, mesh: &TriMesh) -> Sites {
        match kind {
            SiteKind::Face => Sites::of_faces(mesh),
            SiteKind::Vertex => Sites::of_vertices(mesh),
        }
    }

    /// The same sites, with those of a set of views that see them.
    pub fn seen_by(mut self, views: &[View], set: ViewSet) -> Sites {
        let Sites {
            points,
            normals,
            visible,
            ..
        } = &mut self;
        let gazes: Vec<(usize, Gaze)> = views
            .iter()
            .enumerate()
            .filter(|(k, _)| set >> k & 1 == 1)
            .map(|(k, view)| (k, Gaze::new(view)))
            .collect();
        let places = points.par_chunks(LANES).zip(normals.par_chunks(LANES));
        let tiles = visible.par_chunks_mut(LANES).zip(places);
        let tiles = tiles.with_max_len(TILE / LANES);
        tiles.for_each(|(visible, (points, normals))| {
            let (mut places, mut directions) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
            for (lane, (point, normal)) in points.iter().zip(normals).enumerate() {
                set_lane(&mut places, lane, &point.coords);
                set_lane(&mut directions, lane, normal);
            }
            for (k, gaze) in &gazes {
                let is_seen = gaze.sees(&places, &directions);
                for (set, is_seen) in visible.iter_mut().zip(is_seen) {
                    *set |= ViewSet::from(is_seen) << k;
                }
            }
        });
        self
    }

    fn of_faces(mesh: &TriMesh) -> Sites {
        let n_faces = mesh.faces.len();
        let faces = (0..n_faces).into_par_iter();
        let of_face = |face| unit_normal(mesh, face).unwrap_or((Vector3::zeros(), 0.0));
        let (normals, areas_m2) = faces.clone().map(of_face).unzip();
        Sites {
            kind: SiteKind::Face,
            points: faces.map(|face| mesh.centroid(face)).collect(),
            normals,
            areas_m2,
            visible: vec![0; n_faces],
            gloss: SiteGloss::default(),
        }
    }

    fn of_vertices(mesh: &TriMesh) -> Sites {
        let n_vertices = mesh.vertices.len();
        // A third of each face: its area vector, and its area.
        let sums = mesh.sums_at_vertices(Vector4::zeros(), |face| {
            let third = mesh.face_normal(face) / 6.0;
            third.push(third.norm())
        });
        let normal_and_area = |sum: Vector4<f64>| {
            let (along, area_m2) = (sum.xyz(), sum.w);
            match along.norm() {
                norm if norm > MIN_FLATNESS * area_m2 => (along / norm, area_m2),
                _ => (Vector3::zeros(), area_m2),
            }
        };
        let (normals, areas_m2) = sums.into_iter().map(normal_and_area).unzip();
        Sites {
            kind: SiteKind::Vertex,
            points: mesh.vertices.clone(),
            normals,
            areas_m2,
            visible: vec![0; n_vertices],
            gloss: SiteGloss::default(),
        }
    }

    /// The views that see any of them.
    pub fn seeing(&self) -> ViewSet {
        self.visible.iter().fold(0, |all, of| all | of)
    }

    /// Whether any view sees each of them.
    pub fn are_seen(&self) -> Vec<bool> {
        self.visible.iter().map(|of| *of != 0).collect()
    }

    /// The same sites, seen by a set of views alone.
    pub fn only(&self, set: ViewSet) -> Sites {
        let mut sites = self.clone();
        sites.visible.iter_mut().for_each(|visible| *visible &= set);
        sites
    }

    /// The same sites with some gloss.
    pub fn with_gloss(self, gloss: SiteGloss) -> Sites {
        Sites { gloss, ..self }
    }

    /// Makes a site a lane of pieces of surface, which are [matte](SiteGloss::is_matte) as all of these are.
    #[inline]
    pub fn write(&self, site: usize, surfels: &mut Surfels, lane: usize) {
        set_lane(&mut surfels.points, lane, &self.points[site].coords);
        set_lane(&mut surfels.normals, lane, &self.normals[site]);
        if let Some(gloss) = &mut surfels.gloss {
            gloss[lane] = self.gloss.of(site);
        }
    }

    /// What a site looks like in a view, by what the view shows there, as of [`View::sample`].
    pub fn sample(&self, site: usize, view: &View, look: &Look) -> Option<Sample> {
        view.sample(look, &self.normals[site], &self.gloss.of(site))
    }

    /// The sites that a view sees.
    pub fn of_view(&self, view: usize) -> Vec<u32> {
        (0..self.visible.len() as u32)
            .filter(|&site| self.visible[site as usize] >> view & 1 == 1)
            .collect()
    }

    /// What a value of the sites is at a face: its own, or the mean of its corners'.
    pub fn at_face(&self, mesh: &TriMesh, values: &[f64], face: usize) -> f64 {
        match self.kind {
            SiteKind::Face => values[face],
            SiteKind::Vertex => mesh.mean_at_face(face, |vertex| values[vertex]),
        }
    }

    /// Share of the light that is predicted to come over other surfaces, of all that the views show.
    pub fn indirect_share(&self, views: &[View]) -> f64 {
        let of_view = |(k, view): (usize, &View)| {
            let (mut indirect, mut arriving) = (0.0, 0.0);
            let seen = self.of_view(k);
            let points = seen.iter().map(|&site| &self.points[site as usize]);
            Gaze::new(view).each(points, |index, look| {
                if let Some(Sample { normal_camera, .. }) =
                    self.sample(seen[index] as usize, view, look)
                {
                    indirect += normal_camera.dot(&look.indirect);
                    arriving += normal_camera.dot(&look.arriving());
                }
            });
            (indirect, arriving)
        };
        let sums: Vec<(f64, f64)> = views.par_iter().enumerate().map(of_view).collect();
        let (indirect, arriving) = sums
            .into_iter()
            .fold((0.0, 0.0), |(a, b), (c, d)| (a + c, b + d));
        indirect / f64::max(arriving, f64::MIN_POSITIVE)
    }

    /// Rendered against observed linear intensity, by view.
    pub fn view_errors(&self, views: &[View], albedo: &[f64]) -> Vec<ViewError> {
        views
            .par_iter()
            .enumerate()
            .map(|(k, view)| {
                let (mut square, mut sum, mut n_sites) = (0.0, 0.0, 0usize);
                let seen = self.of_view(k);
                let points = seen.iter().map(|&site| &self.points[site as usize]);
                Gaze::new(view).each(points, |index, look| {
                    let site = seen[index] as usize;
                    if let Some(sample) = self.sample(site, view, look) {
                        let error = look.observed - albedo[site] * sample.unit_prediction;
                        square += error * error;
                        sum += look.observed;
                        n_sites += 1;
                    }
                });
                let n = n_sites.max(1) as f64;
                ViewError {
                    n_sites,
                    rmse: (square / n).sqrt() / (sum / n).max(f64::MIN_POSITIVE),
                }
            })
            .collect()
    }
}
