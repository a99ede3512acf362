//! What both ways to shading images have: the candidates so far, and the IR frames that are none.

use super::information::{Optics, ViewInformation};
use super::pool::Pool;
use super::rejection::{RejectReason, Rejection, Rejections};
use super::{ShadingSnapshot, SnapshotParams, SnapshotSelection};

/// The candidates for shading images, and what speaks against the other frames.
pub(super) struct Candidates {
    pub(super) optics: Optics,
    pub(super) params: SnapshotParams,
    pub(super) pool: Pool,
    pub(super) rejected: Rejections,
    /// Whether the operator asked for the next good image.
    pub(super) is_requested: bool,
    /// Images that were candidates until it turned out that the lamp had not lit them.
    pub(super) n_revoked: usize,
}

impl Candidates {
    pub(super) fn new(optics: Optics, params: SnapshotParams) -> Self {
        Candidates {
            optics,
            pool: Pool::new(2 * params.max_snapshots),
            params,
            rejected: Rejections::default(),
            is_requested: false,
            n_revoked: 0,
        }
    }

    /// Takes in an image that is as good as the operator can ask for; one that was asked for is not outdone.
    pub(super) fn offer(&mut self, snapshot: ShadingSnapshot, view: &ViewInformation) {
        let outdone = match std::mem::take(&mut self.is_requested) {
            true => self.pool.pin(snapshot, view),
            false => self.pool.offer(snapshot, view),
        };
        self.rejected.extend(outdone);
    }

    pub(super) fn reject(&mut self, frame_id: u64, reason: RejectReason) {
        self.rejected.extend([Rejection { frame_id, reason }]);
    }

    /// Takes back the candidates against which `reason` finds something after all. A request that one of them had met stands again.
    pub(super) fn revoke(&mut self, reason: impl Fn(&ShadingSnapshot) -> Option<Rejection>) {
        let (rejected, n_revoked) = (&mut self.rejected, &mut self.n_revoked);
        let met_a_request = self.pool.retain(|held| {
            let reason = reason(held);
            let stays = reason.is_none();
            *n_revoked += usize::from(!stays);
            rejected.extend(reason);
            stays
        });
        self.is_requested |= met_a_request;
    }

    /// The choice among them.
    pub(super) fn finish(mut self) -> SnapshotSelection {
        let (n, min_gain_share) = (self.params.max_snapshots, self.params.min_gain_share);
        let (accepted, outdone) = self.pool.choose(n, min_gain_share);
        self.rejected.extend(outdone);
        SnapshotSelection {
            accepted,
            rejected: self.rejected.by_frame(),
        }
    }
}
