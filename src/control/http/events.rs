//! Events as a stream: server-sent, numbered, resumed where they were left.

use super::{
    App,
    problem::{Problem, ProblemBody},
};
use crate::control::{
    events::{Event, Topic},
    status_body::StatusBody,
};
use axum::{
    extract::State,
    http::{HeaderMap, StatusCode},
    response::{
        Sse,
        sse::{self, KeepAlive},
    },
};
use futures_util::{Stream, stream};
use std::{convert::Infallible, sync::Arc};
use tokio::sync::{OwnedSemaphorePermit, watch};

/// Events as they happen: `status`, `state`, `snapshot`, `loss`, `refinement`, `device`; the whole status first
///
/// `Last-Event-ID` resumes after that event, as far as it is still kept.
#[utoipa::path(get, path = "/api/v1/events", responses(
    (status = 200, content_type = "text/event-stream", body = String),
    (status = "default", body = ProblemBody, content_type = "application/problem+json"),
))]
pub async fn events(
    State(app): State<Arc<App>>,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<sse::Event, Infallible>>>, Problem> {
    let place = app.streams.clone().try_acquire_owned();
    let place = place.map_err(|_| {
        let detail = "too many streams of events are open";
        Problem::new(StatusCode::SERVICE_UNAVAILABLE, "too_many_clients", detail)
    })?;
    let newest = app.supervisor.events.follow();
    let resumed = headers.get("last-event-id");
    let resumed = resumed.and_then(|id| id.to_str().ok()?.parse::<u64>().ok());
    let now = *newest.borrow();
    let follower = Follower {
        // A number that was never given is of another daemon's life.
        told: resumed.filter(|told| *told <= now).unwrap_or(now),
        app,
        newest,
        is_first: true,
        _place: place,
    };
    let events = stream::unfold(follower, |mut follower| async move {
        let event = follower.next().await?;
        Some((Ok(event), follower))
    });
    Ok(Sse::new(events).keep_alive(KeepAlive::default()))
}

/// Somebody who follows the events.
struct Follower {
    app: Arc<App>,
    newest: watch::Receiver<u64>,
    /// Number of the last event that was told.
    told: u64,
    is_first: bool,
    _place: OwnedSemaphorePermit,
}

impl Follower {
    /// Waits for the next event.
    async fn next(&mut self) -> Option<sse::Event> {
        if std::mem::take(&mut self.is_first) {
            let status = StatusBody::of(&self.app.supervisor, self.app.n_clients());
            let first = sse::Event::default()
                .event(Topic::Status.name())
                .id(self.told.to_string());
            return first.json_data(&status).ok();
        }
        loop {
            if let Some(event) = self.app.supervisor.events.after(self.told) {
                self.told = event.number;
                return Some(sent(&event));
            }
            self.newest.changed().await.ok()?;
        }
    }
}

fn sent(event: &Event) -> sse::Event {
    sse::Event::default()
        .event(event.topic.name())
        .id(event.number.to_string())
        .data(&event.data)
}
