//! The WebSocket of a page: status and previews, newest only.
//!
//! Nothing is queued: a message is made when the one before has left, so that a slow client skips frames and costs no memory.

use super::{
    App,
    problem::{Problem, ProblemBody},
};
use crate::{
    control::status_body::StatusBody,
    geometry::Pose,
    pipeline::{LivePose, Preview},
};
use axum::{
    extract::{
        State,
        ws::{Message, WebSocket, WebSocketUpgrade, rejection::WebSocketUpgradeRejection},
    },
    http::StatusCode,
    response::Response,
};
use serde::Deserialize;
use std::{sync::Arc, time::Duration};
use tokio::{
    sync::OwnedSemaphorePermit,
    time::{self, MissedTickBehavior},
};

/// Time between previews.
const PREVIEW_INTERVAL: Duration = Duration::from_millis(100);

/// The status is sent with every so many previews.
const STATUS_EVERY: u32 = 2;

/// How long a client may take for one message.
const PATIENCE: Duration = Duration::from_secs(10);

/// Longest message of a client, bytes.
const MAX_MESSAGE: usize = 4096;

/// Before the pixels of a preview, bytes.
const HEADER: usize = 24;

/// What a client of the WebSocket may say.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Wish {
    /// Whether it wants previews.
    Want {
        /// It does.
        previews: bool,
    },
}

impl Wish {
    /// What a message says; `None` for one that makes no sense.
    pub fn parse(message: &str) -> Option<Self> {
        serde_json::from_str(message).ok()
    }
}

/// Status and previews as they are, newest only (WebSocket)
///
/// The server sends the status as text, at most five times a second, and, to whom said `{"type":"want","previews":true}`,
/// binary previews at most ten times a second; see `docs/api.md`.
#[utoipa::path(get, path = "/api/v1/ws", responses(
    (status = 101, description = "the protocol is WebSocket from here on"),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn socket(
    State(app): State<Arc<App>>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let upgrade = upgrade.map_err(|rejection| {
        Problem::new(rejection.status(), "no_websocket", rejection.body_text())
    })?;
    let place = app.sockets.clone().try_acquire_owned();
    let place = place.map_err(|_| {
        let detail = "too many sockets are open";
        Problem::new(StatusCode::SERVICE_UNAVAILABLE, "too_many_clients", detail)
    })?;
    let upgrade = upgrade
        .max_message_size(MAX_MESSAGE)
        .max_frame_size(MAX_MESSAGE)
        .write_buffer_size(0);
    Ok(upgrade.on_upgrade(|socket| converse(socket, app, place)))
}

async fn converse(mut socket: WebSocket, app: Arc<App>, _place: OwnedSemaphorePermit) {
    let mut ticks = time::interval(PREVIEW_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut sent = Sent::default();
    loop {
        let goes_on = tokio::select! {
            said = socket.recv() => sent.heard(said),
            _ = ticks.tick() => {
                let told = time::timeout(PATIENCE, sent.tell_newest(&mut socket, &app)).await;
                told.is_ok_and(|told| told.is_ok())
            }
        };
        if !goes_on {
            return;
        }
    }
}

/// What a client wants, and what it has.
#[derive(Debug, Default)]
struct Sent {
    wants_previews: bool,
    n_ticks: u32,
    depth: Option<u64>,
    infrared: Option<u64>,
    pose: Option<(u64, bool)>,
}

impl Sent {
    /// Takes what the client said; false if it is gone, or says what makes no sense.
    fn heard(&mut self, said: Option<Result<Message, axum::Error>>) -> bool {
        match said {
            Some(Ok(Message::Text(text))) => match Wish::parse(&text) {
                Some(Wish::Want { previews }) => {
                    self.wants_previews = previews;
                    true
                }
                None => false,
            },
            Some(Ok(Message::Ping(_) | Message::Pong(_))) => true,
            Some(Ok(Message::Binary(_) | Message::Close(_)) | Err(_)) | None => false,
        }
    }

    async fn tell_newest(&mut self, socket: &mut WebSocket, app: &App) -> Result<(), axum::Error> {
        if self.n_ticks.is_multiple_of(STATUS_EVERY) {
            let status = StatusBody::of(&app.supervisor, app.n_clients());
            socket.send(Message::text(status_message(&status))).await?;
        }
        self.n_ticks = self.n_ticks.wrapping_add(1);
        let Some(scan) = app.supervisor.scan().filter(|_| self.wants_previews) else {
            return Ok(());
        };
        let live = scan.watch.live();
        if let Some(depth) = live.depth().filter(|new| Some(new.frame_id) != self.depth) {
            self.depth = Some(depth.frame_id);
            socket
                .send(Message::binary(preview_message(1, &depth)))
                .await?;
        }
        if let Some(infrared) = live
            .infrared()
            .filter(|new| Some(new.frame_id) != self.infrared)
        {
            self.infrared = Some(infrared.frame_id);
            socket
                .send(Message::binary(preview_message(2, &infrared)))
                .await?;
        }
        let is_new = |new: &LivePose| Some((new.frame_id, new.is_lost)) != self.pose;
        if let Some(pose) = live.pose().filter(|new| is_new(new)) {
            self.pose = Some((pose.frame_id, pose.is_lost));
            socket.send(Message::binary(pose_message(&pose))).await?;
        }
        Ok(())
    }
}

fn status_message(status: &StatusBody) -> String {
    /// The status with its type before it.
    #[derive(serde::Serialize)]
    struct Typed<'a> {
        #[serde(rename = "type")]
        message_type: &'static str,
        #[serde(flatten)]
        status: &'a StatusBody,
    }
    let typed = Typed {
        message_type: "status",
        status,
    };
    // Numbers, strings and lists of them always have a form in JSON.
    serde_json::to_string(&typed).unwrap_or_default()
}

fn header(kind: u8, frame_id: u64, range: [f32; 2], size: [u16; 2], n_after: usize) -> Vec<u8> {
    let mut message = Vec::with_capacity(HEADER + n_after);
    message.extend([kind, 0, 0, 0]);
    message.extend((frame_id as u32).to_le_bytes());
    message.extend(range.into_iter().flat_map(f32::to_le_bytes));
    message.extend(size.into_iter().flat_map(u16::to_le_bytes));
    message.extend([0; 4]);
    message
}

fn preview_message(kind: u8, preview: &Preview) -> Vec<u8> {
    let range = [preview.low, preview.high];
    let size = [preview.width, preview.height];
    let mut message = header(kind, preview.frame_id, range, size, preview.pixels.len());
    message.extend(&preview.pixels);
    message
}

fn pose_message(pose: &LivePose) -> Vec<u8> {
    let mut message = header(3, pose.frame_id, [0.0; 2], [0; 2], 129);
    for pose in [&pose.world_from_camera, &pose.last_good] {
        message.extend(row_major(pose).into_iter().flat_map(f32::to_le_bytes));
    }
    message.push(u8::from(pose.is_lost));
    message
}

fn row_major(pose: &Pose) -> [f32; 16] {
    let matrix = pose.to_homogeneous();
    std::array::from_fn(|k| matrix[(k / 4, k % 4)] as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Isometry3, Vector3};

    #[test]
    fn messages_have_the_documented_layout() {
        let preview = Preview {
            frame_id: 7,
            width: 3,
            height: 2,
            low: 0.5,
            high: 2.0,
            pixels: vec![0, 1, 254, 255, 5, 6],
        };
        let message = preview_message(2, &preview);
        assert_eq!(message.len(), HEADER + 6);
        assert_eq!(message[..8], [2, 0, 0, 0, 7, 0, 0, 0]);
        assert_eq!(message[12..16], 2.0f32.to_le_bytes());
        assert_eq!(message[16..24], [3, 0, 2, 0, 0, 0, 0, 0]);
        assert_eq!(message[24..], preview.pixels);

        let moved = Isometry3::new(Vector3::new(0.1, 0.2, 0.3), Vector3::zeros());
        let message = pose_message(&LivePose {
            frame_id: 9,
            world_from_camera: moved,
            last_good: Isometry3::identity(),
            is_lost: true,
        });
        assert_eq!(message.len(), HEADER + 129);
        let element = |k: usize| {
            let at = HEADER + 4 * k;
            f32::from_le_bytes(message[at..at + 4].try_into().unwrap())
        };
        assert_eq!([element(3), element(7), element(11)], [0.1, 0.2, 0.3]);
        assert_eq!(
            (element(15), element(16), message[HEADER + 128]),
            (1.0, 1.0, 1)
        );
    }

    #[test]
    fn a_client_that_makes_no_sense_is_left() {
        let mut sent = Sent::default();
        let text = |text: &str| Some(Ok(Message::text(text)));
        assert!(sent.heard(text(r#"{"type":"want","previews":true}"#)));
        assert!(sent.wants_previews);
        for wrong in [
            "",
            "{}",
            r#"{"type":"want"}"#,
            r#"{"type":"other","previews":true}"#,
        ] {
            assert!(!sent.heard(text(wrong)), "{wrong}");
        }
        assert!(!sent.heard(None));
    }
}
