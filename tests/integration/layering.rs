//! Who may know whom: the imports of every module of `src` against the table of the architecture.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

/// What each module may import of its own crate. The program itself may know all.
const ALLOWED: &[(&str, &[&str])] = &[
    ("atomic_file", &[]),
    ("geometry", &[]),
    ("lock", &[]),
    ("robust", &[]),
    ("shading", &["geometry"]),
    ("capture", &["geometry"]),
    ("fusion", &["geometry", "shading"]),
    ("interreflection", &["robust", "geometry", "shading"]),
    (
        "multipath",
        &["robust", "geometry", "shading", "interreflection", "fusion"],
    ),
    (
        "depth_correction",
        &[
            "geometry",
            "robust",
            "shading",
            "interreflection",
            "multipath",
            "fusion",
        ],
    ),
    ("snapshot", &["robust", "geometry", "shading", "fusion"]),
    (
        "calibrate",
        &["robust", "geometry", "shading", "fusion", "snapshot"],
    ),
    (
        "refine",
        &[
            "robust",
            "geometry",
            "shading",
            "interreflection",
            "fusion",
            "snapshot",
        ],
    ),
    ("export", &["geometry", "shading", "atomic_file"]),
    ("devices", &[]),
    ("evaluate", &["robust", "geometry", "shading"]),
    ("jobs", &["atomic_file", "lock", "pipeline"]),
    (
        "config",
        &[
            "geometry",
            "capture",
            "devices",
            "multipath",
            "fusion",
            "snapshot",
            "refine",
            "shading",
            "atomic_file",
            "jobs",
        ],
    ),
    (
        "pipeline",
        &[
            "robust",
            "geometry",
            "lock",
            "shading",
            "capture",
            "multipath",
            "depth_correction",
            "fusion",
            "snapshot",
            "refine",
            "export",
        ],
    ),
    (
        "control",
        &[
            "pipeline",
            "devices",
            "jobs",
            "config",
            "export",
            "geometry",
            "atomic_file",
            "lock",
        ],
    ),
];

/// Files of the program, which puts everything together.
const PROGRAM: &[&str] = &["main", "cli", "lib"];

/// Every source file under a folder.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

fn source_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src")
}

/// The file's text without comments.
fn code_of(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let code = |line: &str| {
        line.split_once("//")
            .map_or(line, |(code, _)| code)
            .to_owned()
    };
    text.lines().map(code).collect::<Vec<_>>().join("\n")
}

/// The top-level module that a file belongs to.
fn module_of(path: &Path) -> String {
    let inside = path.strip_prefix(source_folder()).unwrap();
    let first = inside.components().next().unwrap().as_os_str();
    first.to_str().unwrap().trim_end_matches(".rs").to_owned()
}

fn leading_name(text: &str) -> String {
    text.trim_start()
        .chars()
        .take_while(|c| c.is_alphanumeric() || *c == '_')
        .collect()
}

/// The modules that follow `crate::` anywhere in the code, groups in braces included.
fn imports(code: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (_, after) in code
        .match_indices("crate::")
        .map(|(at, _)| code.split_at(at))
    {
        let after = &after["crate::".len()..];
        match after.strip_prefix('{') {
            Some(group) => found.extend(group_heads(group)),
            None => {
                found.insert(leading_name(after));
            }
        }
    }
    found.remove("");
    found
}

/// The first name of each member of a group whose opening brace has been read.
fn group_heads(group: &str) -> Vec<String> {
    let mut heads = vec![leading_name(group)];
    let mut depth = 1;
    for (at, c) in group.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 1 => heads.push(leading_name(&group[at + 1..])),
            _ => {}
        }
        if depth == 0 {
            break;
        }
    }
    heads
}

#[test]
fn imports_are_found_in_groups_and_paths() {
    let code = "use crate::{a::{b, c}, d,\n  e::f};\nuse crate::g::h;\nlet x = crate::i();";
    let found: Vec<String> = imports(code).into_iter().collect();
    assert_eq!(found, ["a", "d", "e", "g", "i"]);
}

#[test]
fn modules_import_only_what_the_table_allows() {
    for path in sources(&source_folder()) {
        let module = module_of(&path);
        if PROGRAM.contains(&module.as_str()) {
            continue;
        }
        let (_, allowed) = ALLOWED
            .iter()
            .find(|(name, _)| *name == module)
            .unwrap_or_else(|| panic!("{module} is not in the table"));
        for import in imports(&code_of(&path)) {
            assert!(
                import == module || allowed.contains(&import.as_str()),
                "{}: {module} must not import {import}",
                path.display()
            );
        }
    }
}

#[test]
fn tokio_stays_in_control_and_anyhow_in_the_program() {
    for path in sources(&source_folder()) {
        let (module, code) = (module_of(&path), code_of(&path));
        let is_program = PROGRAM.contains(&module.as_str());
        assert!(
            !code.contains("tokio") || module == "control" || module == "main",
            "{}: tokio",
            path.display()
        );
        assert!(
            !code.contains("anyhow") || is_program,
            "{}: anyhow",
            path.display()
        );
    }
}

#[test]
fn no_unsafe_code_outside_the_drivers() {
    for path in sources(&source_folder()) {
        // The lint, and a word of the policy under which a report's page is shown.
        let code = code_of(&path)
            .replace("unsafe_code", "")
            .replace("unsafe-inline", "");
        assert!(!code.contains("unsafe"), "{}: unsafe", path.display());
    }
    for root in ["lib.rs", "main.rs"] {
        let code = code_of(&source_folder().join(root));
        assert!(code.contains("#![forbid(unsafe_code)]"), "{root}");
    }
}
