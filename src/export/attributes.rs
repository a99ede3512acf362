//! What a mesh's file says of every vertex beside its place and normal.

use super::ExportError;
use std::path::Path;

/// Columns of one value a vertex.
#[derive(Clone, Copy, Debug)]
pub struct VertexAttributes<'a> {
    /// Albedo times the light's strength, m².
    pub albedo: &'a [f64],
    /// Standard deviation of the displacement, metres.
    pub sigma_m: &'a [f64],
    /// Share of the displacement's variance that the images took away, 0 to 1.
    pub confidence: &'a [f64],
    /// Share of what is known of the worst known tilt that the images say, 0 to 1.
    pub coverage: &'a [f64],
    /// Views that see the vertex.
    pub n_views: &'a [u8],
    /// Which group of equal albedo it belongs to.
    pub label: &'a [u8],
}

impl<'a> VertexAttributes<'a> {
    /// The columns of numbers with their names in files.
    pub(super) fn floats(&self) -> [(&'static str, &'a [f64]); 4] {
        [
            ("albedo", self.albedo),
            ("sigma", self.sigma_m),
            ("confidence", self.confidence),
            ("coverage", self.coverage),
        ]
    }

    /// The columns of counts with their names in files.
    pub(super) fn counts(&self) -> [(&'static str, &'a [u8]); 2] {
        [("views", self.n_views), ("label", self.label)]
    }

    /// Checks that every column has a value for each vertex, finite and not negative.
    ///
    /// # Errors
    /// [`ExportError::Unfit`] naming the column and the first offender.
    pub(super) fn check(&self, path: &Path, n_vertices: usize) -> Result<(), ExportError> {
        let floats = self.floats().map(|(name, column)| (name, column.len()));
        let counts = self.counts().map(|(name, column)| (name, column.len()));
        let mut lengths = floats.into_iter().chain(counts);
        if let Some((name, n)) = lengths.find(|(_, n)| *n != n_vertices) {
            let reason = format!("{n} values of {name} for {n_vertices} vertices");
            return Err(ExportError::unfit(path, reason));
        }
        for (name, column) in self.floats() {
            let fit = |value: &f64| (*value as f32).is_finite() && *value >= 0.0;
            if let Some(vertex) = column.iter().position(|value| !fit(value)) {
                let value = column[vertex];
                let reason =
                    format!("{name} of vertex {vertex} is {value}, must be finite and at least 0");
                return Err(ExportError::unfit(path, reason));
            }
        }
        Ok(())
    }
}
