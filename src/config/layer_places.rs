//! Where the layers of the configuration lie on a machine.

use super::ConfigError;
use std::{
    env,
    ffi::OsString,
    fs, io,
    path::{Path, PathBuf},
};

/// The machine's files are looked for under this folder instead of `/`, if the variable is set.
const ROOT_VARIABLE: &str = "RELIEF_CONFIG_ROOT";

/// Where layers come from.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Source {
    /// A file that may be missing.
    File(PathBuf),
    /// The files of a folder that end in `.toml`, by name; it may be missing.
    Folder(PathBuf),
    /// A file that must be there.
    Given(PathBuf),
}

/// Where all layers come from, the lowest first.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LayerPlaces {
    sources: Vec<Source>,
    /// Variables and their values, by name.
    pub(super) environment: Vec<(OsString, OsString)>,
}

impl LayerPlaces {
    /// This machine: `/usr/share/relief/relief.toml`, `/etc/relief/relief.toml`, `/etc/relief/conf.d/*.toml`,
    /// `$XDG_CONFIG_HOME/relief/relief.toml`, the file given, the environment.
    pub fn of_machine(given: Option<&Path>) -> Self {
        let set = |name: &str| env::var_os(name).filter(|value| !value.is_empty());
        let of_home = || set("HOME").map(|home| PathBuf::from(home).join(".config"));
        let of_user = set("XDG_CONFIG_HOME").map(PathBuf::from).or_else(of_home);
        let root = set(ROOT_VARIABLE).map_or_else(|| PathBuf::from("/"), PathBuf::from);
        let variables = env::vars_os().collect();
        LayerPlaces::under(&root, of_user.as_deref(), given).with_environment(variables)
    }

    /// The files of a machine whose root is that folder, and the file given.
    pub fn under(root: &Path, user_config: Option<&Path>, given: Option<&Path>) -> Self {
        let file = |path: &Path| {
            let inside = path.strip_prefix("/").unwrap_or(path);
            root.join(inside).join("relief")
        };
        let etc = file(Path::new("etc"));
        let mut sources = vec![
            Source::File(file(Path::new("usr/share")).join("relief.toml")),
            Source::File(etc.join("relief.toml")),
            Source::Folder(etc.join("conf.d")),
        ];
        let of_user = user_config.map(|folder| Source::File(file(folder).join("relief.toml")));
        sources.extend(of_user);
        sources.extend(given.map(|path| Source::Given(path.to_owned())));
        LayerPlaces {
            sources,
            environment: Vec::new(),
        }
    }

    /// The file given, and nothing of the machine.
    pub fn only(given: Option<&Path>) -> Self {
        LayerPlaces {
            sources: given
                .map(|path| Source::Given(path.to_owned()))
                .into_iter()
                .collect(),
            environment: Vec::new(),
        }
    }

    /// With environment variables.
    pub fn with_environment(self, mut environment: Vec<(OsString, OsString)>) -> Self {
        environment.sort();
        LayerPlaces {
            environment,
            ..self
        }
    }

    /// The files that are there now, in the order in which they are laid on.
    pub(super) fn files(&self) -> Result<Vec<(PathBuf, String)>, ConfigError> {
        let mut files = Vec::new();
        for source in &self.sources {
            match source {
                Source::File(path) => files.extend(read_if_there(path)?),
                Source::Folder(folder) => {
                    for path in toml_files(folder)? {
                        files.extend(read_if_there(&path)?);
                    }
                }
                Source::Given(path) => {
                    let text = fs::read_to_string(path);
                    let text = text.map_err(|error| ConfigError::in_file(path, error))?;
                    files.push((path.clone(), text));
                }
            }
        }
        Ok(files)
    }
}

fn read_if_there(path: &Path) -> Result<Option<(PathBuf, String)>, ConfigError> {
    match fs::read_to_string(path) {
        Ok(text) => Ok(Some((path.to_owned(), text))),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(ConfigError::in_file(path, error)),
    }
}

fn toml_files(folder: &Path) -> Result<Vec<PathBuf>, ConfigError> {
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(|error| ConfigError::in_file(folder, error))?,
    };
    let mut files = Vec::new();
    for entry in entries {
        let path = entry
            .map_err(|error| ConfigError::in_file(folder, error))?
            .path();
        if path.extension().is_some_and(|kind| kind == "toml") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}
