//! The checked-in bindings are what bindgen makes of the header.
//!
//! `cargo test -p freenect2-sys --features regenerate`; `RELIEF_WRITE_BINDINGS=1` writes them anew.

#[test]
fn bindings_are_those_of_the_header() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let generated = bindgen::Builder::default()
        .header("shim/freenect2_shim.h")
        .allowlist_item("[fF]2(shim|SHIM).*")
        .rust_target(bindgen::RustTarget::stable(89, 0).expect("bindgen knows the version"))
        .rust_edition(bindgen::RustEdition::Edition2024)
        .layout_tests(true)
        .derive_default(true)
        .prepend_enum_name(false)
        .raw_line(
            "//! Made by bindgen of `shim/freenect2_shim.h`; `tests/bindings.rs` compares the two.",
        )
        .raw_line(
            "#![allow(missing_docs, non_camel_case_types, clippy::all, clippy::undocumented_unsafe_blocks, reason = \"generated\")]",
        )
        .formatter(bindgen::Formatter::Prettyplease)
        .disable_header_comment()
        .generate()
        .expect("libclang reads the header")
        .to_string();
    let path = folder.join("src/bindings.rs");
    if std::env::var_os("RELIEF_WRITE_BINDINGS").is_some() {
        std::fs::write(&path, &generated).expect("the source folder can be written");
    }
    let checked_in = std::fs::read_to_string(&path).expect("bindings are there");
    assert!(generated == checked_in, "src/bindings.rs is out of date");
}
