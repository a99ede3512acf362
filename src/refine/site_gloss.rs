//! How glossy every site of a surface is.

use crate::shading::Gloss;

/// Gloss of sites by their labels, or of all alike; matte by default.
#[derive(Clone, Debug, Default)]
pub struct SiteGloss {
    of_labels: Vec<Gloss>,
    /// Empty where all are alike.
    labels: Vec<u8>,
}

impl SiteGloss {
    /// The same for all.
    pub fn uniform(gloss: Gloss) -> Self {
        Self::of_labels(&[gloss], &[])
    }

    /// That of each site's label.
    pub fn of_labels(of_labels: &[Gloss], labels: &[u8]) -> Self {
        match of_labels.iter().all(Gloss::is_matte) {
            true => SiteGloss::default(),
            false => SiteGloss {
                of_labels: of_labels.to_vec(),
                labels: labels.to_vec(),
            },
        }
    }

    /// Whether no site has any.
    pub fn is_matte(&self) -> bool {
        self.of_labels.is_empty()
    }

    /// That of a site.
    #[inline]
    pub fn of(&self, site: usize) -> Gloss {
        let label = self.labels.get(site).map_or(0, |&label| label as usize);
        self.of_labels.get(label).copied().unwrap_or_default()
    }
}
