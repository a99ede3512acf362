//! What is made once before the rounds: the remeshed object, the views, the pattern of the normal equations.

use super::MAX_VIEWS;
use super::albedo::face_neighbours;
use super::couplings::Couplings;
use super::energy::Surface;
use super::error::{MAX_NON_MANIFOLD_SHARE, RefineError};
use super::held_out::{JudgedView, judge};
use super::optics::Optics;
use super::params::RefineParams;
use super::patches::{self, Patch};
use super::remesh::{RemeshParams, remesh};
use super::rounds::{Rounds, State, centre_of};
use super::self_calibration::{Contradiction, Told, Tolerance, told_by_images};
use super::sites::{Sites, ViewError, ViewSet};
use super::solver::Pattern;
use super::view::{HIDING_CELL_M, SATURATION, View, ViewContext};
use crate::geometry::{EdgeAdjacency, TriMesh, coarsened};
use crate::interreflection::WhiteLevel;
use crate::snapshot::ShadingSnapshot;
use nalgebra::Point3;
use rayon::prelude::*;

/// What is refined, and what from.
#[derive(Clone, Copy)]
pub struct Subject<'a> {
    /// The whole base mesh, which hides the object from camera and light.
    pub scene: &'a TriMesh,
    /// The part of it to refine.
    pub object: &'a TriMesh,
    /// The shading images.
    pub snapshots: &'a [ShadingSnapshot],
    /// Camera, light and response.
    pub optics: &'a Optics<'a>,
}

/// All that the rounds need and do not change.
pub struct Preparation {
    params: RefineParams,
    mesh: TriMesh,
    centre: Point3<f64>,
    views: Vec<View>,
    sites: Sites,
    edges: EdgeAdjacency,
    patches: Vec<Patch>,
    neighbours: Vec<[u32; 3]>,
    pattern: Pattern,
    told: Told,
}

impl Preparation {
    /// Prepares a refinement.
    ///
    /// # Errors
    /// For too many views, for what is no surface, and if memory does not suffice.
    pub fn new(subject: &Subject, params: &RefineParams) -> Result<Self, RefineError> {
        let Subject {
            object,
            snapshots,
            optics,
            ..
        } = *subject;
        if snapshots.len() > MAX_VIEWS {
            return Err(RefineError::TooManyViews {
                n_views: snapshots.len(),
            });
        }
        check_manifold(object)?;
        let params = RefineParams {
            edge_length_m: params.edge_length_for(object.area_m2()),
            ..params.clone()
        };
        let mesh = remesh(object, &RemeshParams::new(params.edge_length_m));
        if mesh.faces.is_empty() {
            return Err(RefineError::NoSurface);
        }
        let centre = centre_of(&mesh);
        let mut views = views_of(subject, &params, centre);
        let mut sites = Sites::new(&mesh, &views, first_views(views.len()));
        let told = ask(&mesh, &sites, &views, optics, &params, Tolerance::FINISHED);
        if let Some(Contradiction { calibration, .. }) = &told.contradiction {
            // Both sets of views are large.
            views.clear();
            let relit = Subject {
                optics: &optics.with(calibration),
                ..*subject
            };
            views = views_of(&relit, &params, centre);
            sites = Sites::new(&mesh, &views, first_views(views.len()));
        }
        views.iter_mut().for_each(|view| view.gloss = told.gloss);
        let edges = EdgeAdjacency::new(&mesh);
        let patches = patches::cut(&mesh, &mesh.vertex_normals(), params.patch_m);
        let couplings = Couplings::new(&mesh, &edges, &patches);
        let neighbours = face_neighbours(&couplings.of_faces, couplings.pairs.len());
        let pattern = Pattern::new(mesh.vertices.len(), couplings);
        Ok(Preparation {
            params,
            mesh,
            centre,
            views,
            sites,
            edges,
            patches,
            neighbours,
            pattern: pattern.ok_or(RefineError::OutOfMemory)?,
            told,
        })
    }

    /// The rounds over it.
    pub fn rounds(&self) -> Rounds<'_> {
        Rounds {
            params: &self.params,
            base_sites: &self.sites,
            edges: &self.edges,
            patches: &self.patches,
            neighbours: &self.neighbours,
            pattern: &self.pattern,
        }
    }

    /// The base surface, with the albedo that a set of views gives it at their tracked poses, and how all views fit it.
    ///
    /// # Errors
    /// If none of them sees it.
    pub fn base(
        &self,
        subject: &Subject,
        learning: ViewSet,
    ) -> Result<(State, Vec<ViewError>), RefineError> {
        let (mesh, views, sites) = (&self.mesh, &self.views, &self.sites);
        let learnt = sites.only(learning);
        let albedo = self.rounds().first_albedo(mesh, &learnt, views);
        let albedo = albedo.ok_or_else(|| self.why_nothing_is_visible(subject))?;
        let errors = sites.view_errors(mesh, views, &albedo.by_face);
        let surface = Surface {
            directions: mesh.vertex_normals(),
            total_m: vec![0.0; mesh.vertices.len()],
            mesh: mesh.clone(),
        };
        let state = State {
            surface,
            views: views.clone(),
            albedo,
        };
        Ok((state, errors))
    }

    /// Refines from a set of views and lets another judge.
    ///
    /// # Errors
    /// If none of the views learnt from sees the base surface.
    pub fn validate(
        &self,
        subject: &Subject,
        learning: ViewSet,
        judges: ViewSet,
    ) -> Result<Vec<JudgedView>, RefineError> {
        let (rounds, (base, _)) = (self.rounds(), self.base(subject, learning)?);
        let mut state = base.clone();
        rounds.run(0..self.params.n_rounds, learning, &mut state, &mut |_| true);
        Ok(judge(&rounds, &base, &mut state, judges))
    }

    /// Mean of the object's vertices, world frame.
    pub fn centre(&self) -> &Point3<f64> {
        &self.centre
    }

    /// Edge length of the mesh, metres.
    pub fn edge_length_m(&self) -> f64 {
        self.params.edge_length_m
    }

    /// What the images said of calibration and gloss; then the views were made with that.
    pub fn told(&self) -> &Told {
        &self.told
    }

    fn why_nothing_is_visible(&self, subject: &Subject) -> RefineError {
        let full_scale = subject.optics.full_scale;
        let is_saturated = |(view, snapshot): &(&View, &ShadingSnapshot)| {
            let counts = &snapshot.ir_counts;
            let pixels = self.mesh.vertices.iter();
            let pixels =
                pixels.filter_map(|point| view.pixel(point, &view.tracked_camera_from_world));
            let inside = pixels.filter(|pixel| view.camera().contains(pixel, 0.0));
            let (n, n_white) = inside.fold((0, 0), |(n, n_white), pixel| {
                let value = f64::from(*counts.at(pixel.x as usize, pixel.y as usize));
                (
                    n + 1,
                    n_white + usize::from(value >= SATURATION * full_scale),
                )
            });
            2 * n_white > n
        };
        let n_views = self.views.len();
        let pairs = self.views.iter().zip(subject.snapshots);
        match pairs.filter(is_saturated).count() {
            0 => RefineError::NothingVisible { n_views },
            n_saturated => RefineError::Saturated {
                n_saturated,
                n_views,
            },
        }
    }
}

/// All shading images made ready.
fn views_of(subject: &Subject, params: &RefineParams, centre: Point3<f64>) -> Vec<View> {
    let Subject {
        scene,
        snapshots,
        optics,
        ..
    } = *subject;
    let context = ViewContext {
        scene: &coarsened(scene, HIDING_CELL_M),
        centre,
        optics,
        trust: &params.trust,
        patches: &optics.patch_grid(),
    };
    let mut views: Vec<View> = snapshots
        .par_iter()
        .map(|snapshot| View::new(snapshot, &context))
        .collect();
    if params.interreflection {
        let white = optics.white_level().or_else(|| plausible_white(&views));
        views.iter_mut().for_each(|view| view.white = white);
    }
    views
}

/// What the views of a surface say of the calibration that they were made with, and of gloss.
fn ask(
    mesh: &TriMesh,
    sites: &Sites,
    views: &[View],
    optics: &Optics,
    params: &RefineParams,
    tolerance: Tolerance,
) -> Told {
    let params = &params.self_calibration;
    match params.enabled {
        true => told_by_images(mesh, sites, views, optics, params, tolerance),
        false => Told::default(),
    }
}

/// What the images of a scan say against its calibration before its depth is corrected for good.
pub fn contradiction_as_tracked(subject: &Subject, params: &RefineParams) -> Option<Contradiction> {
    let (object, optics) = (subject.object, subject.optics);
    let views = views_of(subject, params, centre_of(object));
    let sites = Sites::new(object, &views, first_views(views.len()));
    ask(
        object,
        &sites,
        &views,
        optics,
        params,
        Tolerance::AS_TRACKED,
    )
    .contradiction
}

/// The median of what is plausible for each view: a scan has one light.
fn plausible_white(views: &[View]) -> Option<WhiteLevel> {
    let plausible = views.iter().filter_map(|view| view.plausible_white);
    let mut plausible: Vec<f64> = plausible.map(|WhiteLevel(white)| white).collect();
    let middle = plausible.len() / 2;
    (middle < plausible.len()).then(|| {
        let (_, median, _) = plausible.select_nth_unstable_by(middle, f64::total_cmp);
        WhiteLevel(*median)
    })
}

/// The first so many views.
pub fn first_views(n_views: usize) -> ViewSet {
    (0..n_views).fold(0, |set, view| set | 1 << view)
}

fn check_manifold(object: &TriMesh) -> Result<(), RefineError> {
    let edges = EdgeAdjacency::new(object);
    let of = edges.edges.len();
    let n_edges = edges.n_faces.iter().filter(|&&n| n > 2).count();
    match n_edges as f64 > MAX_NON_MANIFOLD_SHARE * of as f64 {
        true => Err(RefineError::NotManifold { n_edges, of }),
        false => Ok(()),
    }
}
