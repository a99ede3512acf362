//! The page: files that are part of the program.

use super::{path::Path, problem::Problem};
use axum::{
    http::{HeaderMap, StatusCode, header},
    response::{IntoResponse, Response},
};
use sha2::{Digest, Sha256};
use std::sync::LazyLock;

/// A file of the page.
struct Asset {
    name: &'static str,
    media_type: &'static str,
    bytes: &'static [u8],
}

/// The asset of a file in `src/control/page`.
macro_rules! asset {
    ($name:literal, $media_type:literal) => {
        Asset {
            name: $name,
            media_type: $media_type,
            bytes: include_bytes!(concat!("../page/", $name)),
        }
    };
}

const ASSETS: &[Asset] = &[
    asset!("LICENSE.three", "text/plain; charset=utf-8"),
    asset!("api.js", "text/javascript; charset=utf-8"),
    asset!("app.js", "text/javascript; charset=utf-8"),
    asset!("colour.js", "text/javascript; charset=utf-8"),
    asset!("compare.js", "text/javascript; charset=utf-8"),
    asset!("connection.js", "text/javascript; charset=utf-8"),
    asset!("controls.js", "text/javascript; charset=utf-8"),
    asset!("decimate.js", "text/javascript; charset=utf-8"),
    asset!("exports.js", "text/javascript; charset=utf-8"),
    asset!("fitness.js", "text/javascript; charset=utf-8"),
    asset!("health.js", "text/javascript; charset=utf-8"),
    asset!("icon.svg", "image/svg+xml"),
    asset!("index.html", "text/html; charset=utf-8"),
    asset!("kinect1.js", "text/javascript; charset=utf-8"),
    asset!("live_mesh.js", "text/javascript; charset=utf-8"),
    asset!("markers.js", "text/javascript; charset=utf-8"),
    asset!("orbit.js", "text/javascript; charset=utf-8"),
    asset!("previews.js", "text/javascript; charset=utf-8"),
    asset!("refinement.js", "text/javascript; charset=utf-8"),
    asset!("scene.js", "text/javascript; charset=utf-8"),
    asset!("snapshots.js", "text/javascript; charset=utf-8"),
    asset!("stage.js", "text/javascript; charset=utf-8"),
    asset!("style.css", "text/css; charset=utf-8"),
    asset!("surface.js", "text/javascript; charset=utf-8"),
    asset!("three.core.min.js", "text/javascript; charset=utf-8"),
    asset!("three.module.min.js", "text/javascript; charset=utf-8"),
    asset!("wire.js", "text/javascript; charset=utf-8"),
    asset!("words.js", "text/javascript; charset=utf-8"),
];

/// `GET /`
pub async fn index(headers: HeaderMap) -> Result<Response, Problem> {
    serve("index.html", &headers)
}

/// `GET /assets/{name}`
pub async fn asset(Path(name): Path<String>, headers: HeaderMap) -> Result<Response, Problem> {
    serve(&name, &headers)
}

/// Tags of the files by their contents, in order.
static TAGS: LazyLock<Vec<String>> = LazyLock::new(|| {
    let digests = ASSETS.iter().map(|asset| Sha256::digest(asset.bytes));
    let tag = digests.map(|digest| {
        let digits: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        format!("\"{digits}\"")
    });
    tag.collect()
});

fn serve(name: &str, headers: &HeaderMap) -> Result<Response, Problem> {
    let mut assets = ASSETS.iter().zip(TAGS.iter());
    let found = assets.find(|(asset, _)| asset.name == name);
    let (asset, tag) = found.ok_or_else(|| Problem::not_found("the page has no such file"))?;
    let caching = [
        (header::ETAG, tag.as_str()),
        (header::CACHE_CONTROL, "no-cache"),
    ];
    let is_known = headers
        .get(header::IF_NONE_MATCH)
        .is_some_and(|known| known.as_bytes() == tag.as_bytes());
    let kind = [(header::CONTENT_TYPE, asset.media_type)];
    Ok(match is_known {
        true => (StatusCode::NOT_MODIFIED, caching).into_response(),
        false => (caching, kind, asset.bytes).into_response(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{collections::BTreeSet, fs};

    #[test]
    fn every_file_of_the_page_is_served_under_its_kind() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src/control/page");
        let files: BTreeSet<String> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        let served: BTreeSet<String> = ASSETS.iter().map(|asset| asset.name.to_owned()).collect();
        assert_eq!(served, files);
        for asset in ASSETS {
            let expected = match asset.name.rsplit_once('.') {
                Some((_, "html")) => "text/html; charset=utf-8",
                Some((_, "css")) => "text/css; charset=utf-8",
                Some((_, "js")) => "text/javascript; charset=utf-8",
                Some((_, "svg")) => "image/svg+xml",
                _ => "text/plain; charset=utf-8",
            };
            assert_eq!(asset.media_type, expected, "{}", asset.name);
        }
    }
}
