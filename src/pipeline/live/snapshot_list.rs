//! The strip of shading images: those that are held, and the last frames that could have been one and are not, with why.

use super::{
    LiveSnapshot, Preview,
    preview::{THUMBNAIL_COLUMNS, of_infrared},
};
use crate::snapshot::{RejectReason, Rejection, Rejections, SnapshotSelector};
use depth_camera::{Frame, Image};
use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
};

/// Refused frames that are remembered.
const MAX_REFUSED: usize = 32;

/// Remembers what a strip needs beside the selector.
#[derive(Debug, Default)]
pub struct SnapshotList {
    refused: VecDeque<(Rejection, Option<Arc<Preview>>)>,
    /// Of the candidates, by frame.
    thumbnails: BTreeMap<u64, Arc<Preview>>,
    /// How many of the selector's rejections were looked at.
    n_noted: usize,
}

impl SnapshotList {
    /// Looks at what the selector said of a frame. Pictures are made only while somebody looks.
    pub fn note(&mut self, frame: &Frame, rejected: &Rejections, full_scale: Option<f64>) {
        let new = rejected.after(self.n_noted);
        self.n_noted = rejected.count();
        for rejection in new.iter().filter(|rejection| is_told(&rejection.reason)) {
            let is_own = rejection.frame_id == frame.frame_id;
            let picture = frame.ir.as_ref().zip(full_scale).filter(|_| is_own);
            let thumbnail =
                picture.map(|(ir, full_scale)| thumbnail(frame.frame_id, ir, full_scale));
            self.refuse(*rejection, thumbnail);
        }
    }

    /// Of frames in a row that are refused for one reason the last stands for all.
    fn refuse(&mut self, rejection: Rejection, thumbnail: Option<Arc<Preview>>) {
        let last = self.refused.back().map(|(last, _)| last.reason.code());
        if last == Some(rejection.reason.code()) || self.refused.len() == MAX_REFUSED {
            match last == Some(rejection.reason.code()) {
                true => self.refused.pop_back(),
                false => self.refused.pop_front(),
            };
        }
        self.refused.push_back((rejection, thumbnail));
    }

    /// Forgets what is not remembered by the selector any more.
    pub fn forget(&mut self) {
        self.refused.clear();
        self.thumbnails.clear();
    }

    /// The strip, in order of the frames.
    pub fn strip(&mut self, selector: &SnapshotSelector, full_scale: f64) -> Vec<LiveSnapshot> {
        let held = selector.held();
        let mut thumbnails = BTreeMap::new();
        let mut strip = Vec::with_capacity(held.len() + self.refused.len());
        for (snapshot, reason) in held {
            let frame_id = snapshot.frame_id;
            let known = self.thumbnails.remove(&frame_id);
            let picture =
                known.unwrap_or_else(|| thumbnail(frame_id, &snapshot.ir_counts, full_scale));
            thumbnails.insert(frame_id, picture.clone());
            strip.push(told(frame_id, reason, Some(picture)));
        }
        self.thumbnails = thumbnails;
        let refused = self.refused.iter();
        strip.extend(refused.map(|(rejection, thumbnail)| {
            told(
                rejection.frame_id,
                Some(rejection.reason),
                thumbnail.clone(),
            )
        }));
        strip.sort_by_key(|snapshot| snapshot.frame_id);
        strip
    }
}

/// Whether an operator wants to know: most frames of a scan are no shading images, for good reasons.
fn is_told(reason: &RejectReason) -> bool {
    !matches!(
        reason,
        RejectReason::Redundant { .. }
            | RejectReason::NotTracked
            | RejectReason::Speckle { .. }
            | RejectReason::Uncovered { .. }
    )
}

fn told(
    frame_id: u64,
    reason: Option<RejectReason>,
    thumbnail: Option<Arc<Preview>>,
) -> LiveSnapshot {
    LiveSnapshot {
        index: frame_id,
        frame_id,
        accepted: reason.is_none(),
        code: reason.as_ref().map(RejectReason::code),
        advice: reason.as_ref().map(RejectReason::advice),
        reason: reason.map(|reason| reason.to_string()),
        thumbnail,
    }
}

fn thumbnail<T: Copy + Into<f32>>(
    frame_id: u64,
    counts: &Image<T>,
    full_scale: f64,
) -> Arc<Preview> {
    Arc::new(of_infrared(frame_id, counts, full_scale, THUMBNAIL_COLUMNS))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::snapshot::SnapshotParams;
    use depth_camera::DepthCamera;
    use simulated::SimulatedCamera;
    use std::time::Instant;

    fn rejection(frame_id: u64, reason: RejectReason) -> Rejection {
        Rejection { frame_id, reason }
    }

    #[test]
    fn refused_frames_are_told_once_a_reason_and_not_without_end() {
        let camera = SimulatedCamera::kinect2_plaque(1, 0);
        let selector = SnapshotSelector::new(camera.info(), SnapshotParams::default()).unwrap();
        let mut list = SnapshotList::default();
        let mut rejected = Rejections::default();
        for frame_id in 0..200 {
            let reason = match frame_id {
                0..10 => RejectReason::NotTracked,
                10..20 => RejectReason::Saturated { share: 0.5 },
                _ if frame_id % 2 == 0 => RejectReason::NoInformation,
                _ => RejectReason::NoDepth,
            };
            rejected.extend([rejection(frame_id, reason)]);
            let frame = Frame {
                frame_id,
                device_time_secs: 0.0,
                host_time: Instant::now(),
                depth: None,
                ir: Some(Image::filled(256, 4, 100)),
            };
            list.note(&frame, &rejected, Some(65_535.0));
            let strip = list.strip(&selector, 65_535.0);
            assert!(strip.len() <= MAX_REFUSED);
            if frame_id == 19 {
                let [only] = strip.as_slice() else {
                    panic!("one for all of a reason: {strip:?}");
                };
                assert_eq!((only.frame_id, only.accepted), (19, false));
                assert_eq!(only.code, Some("saturated"));
                let sentence = only.reason.as_deref().unwrap();
                assert!(sentence.starts_with("50.0 %"), "{sentence}");
                let thumbnail = only.thumbnail.as_ref().unwrap();
                assert_eq!((thumbnail.width, thumbnail.height), (128, 2));
            }
        }
        assert_eq!(list.strip(&selector, 1.0).last().unwrap().frame_id, 199);
        list.forget();
        assert!(list.strip(&selector, 1.0).is_empty());
    }
}
