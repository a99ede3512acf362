//! What all pages share: one HTML file with everything in it, readable on a desk and on a phone, without scripts.
//!
//! Colours follow the reader's choice of light or dark by `report.css`.

use base64::{Engine, engine::general_purpose::STANDARD};
use maud::{DOCTYPE, Markup, PreEscaped, html};

const STYLE: &str = include_str!("report.css");

/// A whole page around its sections.
pub(super) fn document(title: &str, sections: &Markup) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                link rel="icon" href="data:,";
                style { (PreEscaped(STYLE)) }
            }
            body { main { (sections) } }
        }
    }
}

/// A PNG as an address that needs no file.
pub(super) fn data_address(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}

/// A picture with its caption beneath it.
pub(super) fn figure(address: &str, caption: &str) -> Markup {
    html! { figure { img src=(address) alt=(caption); figcaption { (caption) } } }
}

/// Panics if a page asks for anything outside itself.
#[cfg(test)]
pub(super) fn assert_self_contained(page: &str) {
    for outside in ["http", "//", "url(", "@import", "<script"] {
        // Base64 may hold two slashes in a row.
        let text: String = page
            .split("data:image/png;base64,")
            .enumerate()
            .map(|(k, part)| {
                if k == 0 {
                    part
                } else {
                    part.split_once('"').unwrap().1
                }
            })
            .collect();
        assert!(!text.contains(outside), "{outside}");
    }
    for attribute in ["src=\"", "href=\""] {
        assert!(
            page.split(attribute)
                .skip(1)
                .all(|rest| rest.starts_with("data:"))
        );
    }
}
