//! Albedo: of each site, Eq. (3), of the whole surface, Eq. (2), or of groups of sites that share one material.
//!
//! All are ratios of sums, `Σ w s I / Σ w s²` with `s = gain (n·l)/d²`; the mean of ratios that the paper prints is biased
//! by grazing samples. Groups are the components of a mixture of Gaussians on log albedo whose number the Bayesian information
//! criterion chooses, or the paper's clusters; sites are given to them by Eq. (4), neighbours together, by expansion moves.
//! This is where a round begins: `minimise` then moves the groups' albedos together with the surface. Within a group albedo may
//! differ from site to site (`tint`).

use super::materials::{Materials, SAME_GROUP};
use super::observations::Observations;
use super::site_gloss::SiteGloss;
use super::sites::{SiteKind, Sites};
use crate::geometry::{TriMesh, label_of_most_corners};
use crate::robust::{Tukey, median_absolute_deviation};
use crate::shading::Gloss;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How sites are put into groups of one albedo.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum AlbedoMode {
    /// By a mixture of Gaussians on log albedo with as many components as the Bayesian information criterion asks for.
    #[default]
    Mixture,
    /// By the rule that the paper states in Sec. 4.2, for comparison with it.
    Paper,
}

/// What is to be known of the groups.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct AlbedoParams {
    /// How sites are put into groups.
    pub mode: AlbedoMode,
    /// Whether albedo may differ from site to site within a group; never in the paper's mode.
    pub tints: bool,
}

impl Default for AlbedoParams {
    fn default() -> Self {
        AlbedoParams {
            mode: AlbedoMode::default(),
            tints: true,
        }
    }
}

/// What a group of sites is of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Albedo times the light's strength, m².
    pub albedo: f64,
    /// Share of the sites.
    pub share: f64,
    /// How glossy the images show it to be.
    pub gloss: Gloss,
}

/// Numerator and denominator of a ratio of sums.
pub type Ratio = (f64, f64);

/// Albedo times the light's strength, m², by site and by group.
#[derive(Clone, Debug)]
pub struct Albedo {
    /// Albedo of each site: that of its group times its tint.
    pub by_site: Vec<f64>,
    /// By which factor each site differs from its group.
    pub tints: Vec<f64>,
    /// Group of each site.
    pub labels: Vec<u8>,
    /// Albedo of each group, ascending.
    pub groups: Vec<f64>,
    /// How glossy each group is.
    pub gloss: Vec<Gloss>,
    /// Robust standard deviation of the sites' own log albedos about their groups'.
    pub spread: f64,
}

/// Which groups are looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Groups {
    /// How.
    pub mode: AlbedoMode,
    /// So many at most.
    pub at_most: usize,
}

impl Albedo {
    /// Estimates groups and their albedos; `current` gives the residuals whose outliers do not count. `None` where no site
    /// is seen.
    pub fn estimate(
        sites: &Sites,
        all_neighbours: &[[u32; 2]],
        observations: &Observations,
        groups: Groups,
        current: Option<(&Albedo, Tukey)>,
    ) -> Option<Albedo> {
        let ratios = ratios(sites, observations, current);
        let Materials {
            labels,
            n_groups,
            typical,
        } = Materials::of(sites, all_neighbours, observations, &ratios, groups)?;
        let albedo = Self::of_labels(labels, n_groups, &ratios);
        Some(match current {
            Some((before, _)) => {
                let kept = before.kept_tints(&albedo);
                Albedo {
                    gloss: before.kept_gloss(&albedo),
                    ..albedo.tinted(kept, &ratios)
                }
            }
            // A sum over all of a group is drawn to what of it is painted, or in the shade.
            None => match typical {
                Some(typical) => albedo.with_groups(typical),
                None => albedo,
            },
        })
    }

    /// The tints of those sites that stay in a group of the same albedo.
    fn kept_tints(&self, next: &Albedo) -> Vec<f64> {
        let group = |albedo: &Albedo, site: usize| albedo.groups[albedo.labels[site] as usize];
        let kept = |(site, &tint): (usize, &f64)| {
            let change = (group(next, site) / group(self, site)).ln();
            if change.abs() < SAME_GROUP { tint } else { 1.0 }
        };
        self.tints.iter().enumerate().map(kept).collect()
    }

    /// The gloss of the next groups: each has that of the group which most of its sites were in.
    fn kept_gloss(&self, next: &Albedo) -> Vec<Gloss> {
        let mut counts = vec![vec![0usize; self.groups.len()]; next.groups.len()];
        for (&before, &label) in self.labels.iter().zip(&next.labels) {
            counts[label as usize][before as usize] += 1;
        }
        let kept = |counts: &Vec<usize>| self.gloss[first_of_most(counts)];
        counts.iter().map(kept).collect()
    }

    /// How glossy its sites are.
    pub fn site_gloss(&self) -> SiteGloss {
        SiteGloss::of_labels(&self.gloss, &self.labels)
    }

    /// The same labels with other tints, and the albedos of the groups as Eq. (2) has them then.
    fn tinted(self, tints: Vec<f64>, ratios: &[Ratio]) -> Albedo {
        let n_groups = self.groups.len();
        let untinted = ratios.iter().zip(&tints);
        let untinted: Vec<Ratio> = untinted
            .map(|((n, d), tint)| (n * tint, d * tint * tint))
            .collect();
        let albedo = Self::of_labels(self.labels, n_groups, &untinted);
        Albedo {
            by_site: by_site(&albedo.groups, &albedo.labels, &tints),
            tints,
            gloss: self.gloss,
            // What tints take up is spread all the same.
            spread: self.spread,
            ..albedo
        }
    }

    /// Matte groups with these labels.
    fn of_labels(labels: Vec<u8>, n_groups: usize, ratios: &[Ratio]) -> Albedo {
        let groups = of_groups(&labels, n_groups, ratios);
        let tints = vec![1.0; labels.len()];
        let by_site = by_site(&groups, &labels, &tints);
        let mut offsets: Vec<f64> = ratios
            .par_iter()
            .zip(&by_site)
            .map(|(ratio, albedo): (&Ratio, &f64)| log_albedo(*ratio) - albedo.ln())
            .filter(|offset| offset.is_finite())
            .collect();
        Albedo {
            by_site,
            tints,
            labels,
            gloss: vec![Gloss::default(); n_groups],
            groups,
            spread: median_absolute_deviation(&mut offsets),
        }
    }

    /// The same with other albedos of the groups.
    fn with_groups(mut self, groups: Vec<f64>) -> Albedo {
        let tints = std::mem::take(&mut self.tints);
        self.repaint(groups, tints);
        self
    }

    /// Gives the groups other albedos and the sites other tints.
    pub fn repaint(&mut self, groups: Vec<f64>, tints: Vec<f64>) {
        self.by_site = by_site(&groups, &self.labels, &tints);
        (self.groups, self.tints) = (groups, tints);
    }

    /// All albedos multiplied by a factor.
    pub fn scaled(mut self, factor: f64) -> Albedo {
        self.by_site
            .iter_mut()
            .chain(&mut self.groups)
            .for_each(|albedo| *albedo *= factor);
        self
    }

    /// Albedo of each vertex: its site's, or the mean of the facets' round it.
    pub fn by_vertex(&self, kind: SiteKind, mesh: &TriMesh) -> Vec<f64> {
        if kind == SiteKind::Vertex {
            return self.by_site.clone();
        }
        let sums = mesh.sums_at_vertices(0.0, |face| self.by_site[face]);
        let n_faces = mesh.sums_at_vertices(0.0, |_| 1.0);
        let mean = |(sum, n): (&f64, &f64)| sum / n.max(1.0);
        sums.iter().zip(&n_faces).map(mean).collect()
    }

    /// Group of each vertex: its site's, or that of most facets round it, the darkest of several.
    pub fn labels_by_vertex(&self, kind: SiteKind, mesh: &TriMesh) -> Vec<u8> {
        if kind == SiteKind::Vertex {
            return self.labels.clone();
        }
        let n_groups = self.groups.len();
        let mut counts = vec![0u32; n_groups * mesh.vertices.len()];
        for (face, &label) in mesh.faces.iter().zip(&self.labels) {
            for &vertex in face {
                counts[vertex as usize * n_groups + label as usize] += 1;
            }
        }
        let most = |counts: &[u32]| first_of_most(counts) as u8;
        counts.chunks_exact(n_groups.max(1)).map(most).collect()
    }

    /// The groups as materials.
    pub fn materials(&self) -> Vec<Material> {
        let mut counts = vec![0usize; self.groups.len()];
        self.labels
            .iter()
            .for_each(|&label| counts[label as usize] += 1);
        let groups = self.groups.iter().zip(&self.gloss).zip(counts);
        let material = |((&albedo, &gloss), count)| Material {
            albedo,
            share: count as f64 / self.labels.len().max(1) as f64,
            gloss,
        };
        groups.map(material).collect()
    }
}

/// The group with most, the first of several; the first of none.
pub fn first_of_most(counts: &[impl Ord]) -> usize {
    let most = (0..counts.len()).rev().max_by_key(|&group| &counts[group]);
    most.unwrap_or(0)
}

/// Group of each face, given those of the sites: its site's, or [that of most corners](label_of_most_corners).
pub fn labels_by_face(kind: SiteKind, labels: Vec<u8>, mesh: &TriMesh) -> Vec<u8> {
    if kind == SiteKind::Face {
        return labels;
    }
    let faces = mesh.faces.iter();
    faces
        .map(|&face| label_of_most_corners(face, &labels))
        .collect()
}

/// The albedos of given groups: Eq. (2) within each, and of all sites for one that no site belongs to.
pub fn of_groups(labels: &[u8], n_groups: usize, ratios: &[Ratio]) -> Vec<f64> {
    let plus = |sum: Ratio, ratio: &Ratio| (sum.0 + ratio.0, sum.1 + ratio.1);
    let mut sums: Vec<Ratio> = vec![(0.0, 0.0); n_groups];
    for (&label, ratio) in labels.iter().zip(ratios) {
        sums[label as usize] = plus(sums[label as usize], ratio);
    }
    let (n, d) = ratios.iter().fold((0.0, 0.0), plus);
    let of_sum = |&(numerator, denominator): &Ratio| match denominator > 0.0 {
        true => numerator / denominator,
        false => n / d,
    };
    sums.iter().map(of_sum).collect()
}

fn by_site(groups: &[f64], labels: &[u8], tints: &[f64]) -> Vec<f64> {
    let of_site = |(&label, tint): (&u8, &f64)| groups[label as usize] * tint;
    labels.iter().zip(tints).map(of_site).collect()
}

/// Logarithm of the albedo that sums tell; NaN if they tell none.
pub fn log_albedo((numerator, denominator): Ratio) -> f64 {
    if numerator > 0.0 && denominator > 0.0 {
        (numerator / denominator).ln()
    } else {
        f64::NAN
    }
}

/// The sums of each site over the views that see it.
pub fn ratios(
    sites: &Sites,
    observations: &Observations,
    current: Option<(&Albedo, Tukey)>,
) -> Vec<Ratio> {
    (0..sites.points.len())
        .into_par_iter()
        .map(|site| {
            let mut sums = (0.0, 0.0);
            for seen in observations.of(site) {
                let Some(s) = seen.unit_prediction(&sites.normals[site]) else {
                    continue;
                };
                let observed = f64::from(seen.observed);
                let weight = current.map_or(1.0, |(albedo, loss)| {
                    // An outlier to its group may belong to another: it keeps a small say in where it goes.
                    let robust = loss.weight(observed - albedo.by_site[site] * s);
                    robust.max(1e-3 / (loss.scale * loss.scale))
                });
                sums = (sums.0 + weight * s * observed, sums.1 + weight * s * s);
            }
            sums
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_site_keeps_its_tint_until_it_goes_to_another_material() {
        let ratios = [(0.27, 1.0), (0.33, 1.0), (0.63, 1.0), (0.77, 1.0)];
        let tints = vec![0.9, 1.1, 0.9, 1.1];
        let untinted = Albedo::of_labels(vec![0, 0, 1, 1], 2, &ratios);
        let before = untinted.clone().tinted(tints, &ratios);
        // What tints take up is spread all the same.
        assert!(before.spread > 0.0 && before.spread == untinted.spread);
        for (albedo, tint) in before.by_site.iter().zip([0.9, 1.1]) {
            assert!((albedo / before.groups[0] - tint).abs() < 1e-12);
        }
        let next = Albedo {
            labels: vec![0, 0, 0, 1],
            ..before.clone()
        };
        assert_eq!(before.kept_tints(&next), [0.9, 1.1, 1.0, 1.1]);
    }
}
