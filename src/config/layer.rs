//! One layer of the configuration: some keys with their values, each with its origin.

use super::{Config, ConfigError, Origin, Overrides};
use crate::refine::Crop;
use serde::Deserialize;
use std::{collections::BTreeMap, ffi::OsString, ops::Range, path::Path};
use toml::{
    Spanned, Table, Value,
    de::{DeString, DeTable, DeValue},
};

/// Environment variables that set a key begin so, and have [`SEPARATOR`] between the tables' names.
const PREFIX: &str = "RELIEF_";
const SEPARATOR: &str = "__";

/// What the parser says of a key that is given twice, and of a value that is no name of a choice.
const DUPLICATE: &str = "duplicate key";
const NO_CHOICE: [&str; 2] = [
    "wanted string or table",
    "invalid type: unit variant, expected string only",
];

/// One layer.
#[derive(Clone, Debug, Default)]
pub struct Layer {
    /// The keys with their values, in their tables.
    pub table: Table,
    /// The origin of each key, by its name with the tables' names before it: `fusion.icp.iterations`.
    pub origins: BTreeMap<String, Origin>,
}

impl Layer {
    /// What the stages themselves say.
    ///
    /// # Errors
    /// Never for the parameters that there are: each can be written as TOML.
    pub fn defaults() -> Result<Self, ConfigError> {
        let written = Table::try_from(Config::default());
        let table = written.map_err(|error| ConfigError {
            origin: Origin::Default.to_string(),
            what: error.to_string(),
        })?;
        Ok(Layer::of_one_origin(table, &Origin::Default))
    }

    /// A file's text. Whether values are within their bounds is not looked at.
    ///
    /// # Errors
    /// For what is no TOML, an unknown key and a value of another kind, naming line and key.
    pub fn of_file(path: &Path, text: &str) -> Result<Self, ConfigError> {
        let line = |at: usize| 1 + text.bytes().take(at).filter(|&byte| byte == b'\n').count();
        let at_span = |error: &toml::de::Error, parsed: Option<&DeTable>| {
            let span = error.span();
            let key = span.as_ref().zip(parsed);
            let key = key.and_then(|(span, table)| key_at(table, span.start, ""));
            let what = match (key, error.message()) {
                (Some(key), message) => format!("{key}: {}", with_allowed(&key, message)),
                (None, message @ DUPLICATE) => {
                    let key = span.clone().and_then(|span| text.get(span));
                    format!("{message} `{}`", key.unwrap_or_default())
                }
                (None, message) => message.to_owned(),
            };
            ConfigError {
                origin: match span {
                    Some(span) => Origin::File(path.to_owned(), line(span.start)).to_string(),
                    None => path.display().to_string(),
                },
                what,
            }
        };
        let parsed = DeTable::parse(text).map_err(|error| at_span(&error, None))?;
        let parsed = parsed.get_ref();
        let at_key = |error: toml::de::Error| at_span(&error, Some(parsed));
        toml::from_str::<Config>(text).map_err(at_key)?;
        let table = toml::from_str(text).map_err(at_key)?;
        let mut spans = Vec::new();
        leaf_spans(parsed, "", &mut spans);
        let origin = |span: Range<usize>| Origin::File(path.to_owned(), line(span.start));
        Ok(Layer {
            table,
            origins: spans
                .into_iter()
                .map(|(key, span)| (key, origin(span)))
                .collect(),
        })
    }

    /// The variables named `RELIEF_SECTION__KEY`; a value is TOML, or else a string without its quotes. Other variables are none
    /// of the configuration's.
    ///
    /// # Errors
    /// For an unknown key, also one without the two underscores, and a value that is of another kind or no UTF-8, naming the variable.
    pub fn of_environment(variables: &[(OsString, OsString)]) -> Result<Self, ConfigError> {
        let mut layer = Layer::default();
        for (name, value) in variables {
            let name = name.to_string_lossy();
            let Some(path) = name.strip_prefix(PREFIX) else {
                continue;
            };
            let origin = Origin::Environment(name.clone().into_owned());
            let refused = |what| ConfigError {
                origin: origin.to_string(),
                what,
            };
            let lower = path.to_lowercase();
            let path: Vec<&str> = lower.split(SEPARATOR).collect();
            if path.len() < 2 {
                match meant(&lower)? {
                    Some(key) => return Err(refused(no_key(&key))),
                    None => continue,
                }
            }
            let key = path.join(".");
            let no_text = || refused(format!("{key}: {} is no UTF-8", value.display()));
            let text = value.to_str().ok_or_else(no_text)?;
            let table = nested(&path, value_of(text));
            Config::deserialize(table.clone()).map_err(|error| {
                refused(format!("{key}: {}", with_allowed(&key, error.message())))
            })?;
            layer.lay(Layer::of_one_origin(table, &origin));
        }
        Ok(layer)
    }

    /// The flags.
    pub fn of_overrides(overrides: &Overrides) -> Self {
        let float = |value: Option<f64>| value.map(Value::Float);
        let switch = |value: Option<bool>| value.map(Value::Boolean);
        let count = overrides.max_snapshots;
        let count = count.map(|n| Value::Integer(i64::try_from(n).unwrap_or(i64::MAX)));
        let crop = |crop: Crop| Value::try_from(crop).ok();
        let mut layer = Layer::default();
        for (path, value) in [
            (
                &["fusion", "voxel_size_m"][..],
                float(overrides.voxel_size_m),
            ),
            (&["fusion", "depth_max_m"], float(overrides.depth_max_m)),
            (
                &["fusion", "polish", "enabled"],
                switch(overrides.polish_poses),
            ),
            (&["snapshot", "max_snapshots"], count),
            (&["object", "crop"], overrides.crop.and_then(crop)),
            (&["object", "watertight"], switch(overrides.watertight)),
        ] {
            if let Some(value) = value {
                let table = nested(path, value);
                layer.lay(Layer::of_one_origin(table, &Origin::CommandLine));
            }
        }
        layer
    }

    /// Lays another layer on this one.
    pub fn lay(&mut self, upper: Layer) {
        merge(&mut self.table, &mut self.origins, upper.table, "");
        self.origins.extend(upper.origins);
    }

    fn of_one_origin(table: Table, origin: &Origin) -> Self {
        let mut keys = Vec::new();
        leaves(&table, "", &mut |key, _| keys.push(key));
        let origins = keys.into_iter().map(|key| (key, origin.clone())).collect();
        Layer { table, origins }
    }
}

/// The key that a variable's name without [`SEPARATOR`] is closest to, if it is the name of a table, or begins with one and can only be
/// meant for one of its keys.
fn meant(name: &str) -> Result<Option<String>, ConfigError> {
    let defaults = Layer::defaults()?.table;
    let is_of = |table: &String| {
        name.strip_prefix(table)
            .is_some_and(|rest| rest.is_empty() || rest.starts_with('_'))
    };
    let Some(table) = defaults.keys().find(|table| is_of(table)) else {
        return Ok(None);
    };
    let mut keys = Vec::new();
    leaves(&defaults, "", &mut |key, _| keys.push(key));
    let n_alike = |key: &String| {
        let key = key.replace('.', "_");
        let pairs = key.chars().zip(name.chars());
        pairs
            .take_while(|(of_key, of_name)| of_key == of_name)
            .count()
    };
    let of_table = keys
        .into_iter()
        .filter(|key| key.starts_with(table.as_str()));
    Ok(of_table.max_by_key(n_alike))
}

/// What is said of a variable that is meant for a key and names none.
fn no_key(nearest: &str) -> String {
    let variable = nearest.to_uppercase().replace('.', SEPARATOR);
    format!("names no key; {PREFIX}{variable} sets {nearest}")
}

/// Calls back for every key that is no table, with the tables' names before it.
pub fn leaves(table: &Table, prefix: &str, take: &mut impl FnMut(String, &Value)) {
    for (key, value) in table {
        let name = format!("{prefix}{key}");
        match value {
            Value::Table(inner) => leaves(inner, &format!("{name}."), take),
            _ => take(name, value),
        }
    }
}

/// The key that stands at a place of the text, with its value, or the table that begins there.
fn key_at(table: &DeTable, at: usize, prefix: &str) -> Option<String> {
    table.iter().find_map(|(key, value)| {
        let name = format!("{prefix}{}", key.get_ref());
        match value.get_ref() {
            DeValue::Table(inner) => key_at(inner, at, &format!("{name}."))
                .or_else(|| (value.span().start == at).then_some(name)),
            _ => leaf_span(key, value).contains(&at).then_some(name),
        }
    })
}

/// What is wrong with a key, with the values that it may have where it is one of a few.
fn with_allowed(key: &str, message: &str) -> String {
    if !NO_CHOICE.contains(&message) {
        return message.to_owned();
    }
    // What is none of them is told with all of them.
    let path: Vec<&str> = key.split('.').collect();
    let none = nested(&path, Value::String(String::new()));
    let refused = Config::deserialize(none).err();
    let allowed = refused
        .as_ref()
        .and_then(|error| error.message().split_once("expected "));
    allowed.map_or_else(
        || message.to_owned(),
        |(_, allowed)| format!("must be {allowed}"),
    )
}

/// From the start of the key to the end of its value.
fn leaf_span(key: &Spanned<DeString>, value: &Spanned<DeValue>) -> Range<usize> {
    key.span().start..value.span().end.max(key.span().end)
}

/// As [`leaves`], with the places in the text.
fn leaf_spans(table: &DeTable, prefix: &str, found: &mut Vec<(String, Range<usize>)>) {
    for (key, value) in table {
        let name = format!("{prefix}{}", key.get_ref());
        match value.get_ref() {
            DeValue::Table(inner) => leaf_spans(inner, &format!("{name}."), found),
            _ => found.push((name, leaf_span(key, value))),
        }
    }
}

/// Tables are merged; of anything else the upper takes the lower's place, whose origins are forgotten.
fn merge(lower: &mut Table, origins: &mut BTreeMap<String, Origin>, upper: Table, prefix: &str) {
    for (key, value) in upper {
        let name = format!("{prefix}{key}");
        match (lower.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above)) => {
                merge(below, origins, above, &format!("{name}."));
            }
            (_, value) => {
                let inside = format!("{name}.");
                origins.retain(|key, _| *key != name && !key.starts_with(&inside));
                lower.insert(key, value);
            }
        }
    }
}

fn nested(path: &[&str], value: Value) -> Table {
    let mut table = Table::new();
    if let [first, rest @ ..] = path {
        let value = match rest {
            [] => value,
            _ => Value::Table(nested(rest, value)),
        };
        table.insert((*first).to_owned(), value);
    }
    table
}

/// A value as it would stand in a file, or the text itself.
fn value_of(text: &str) -> Value {
    let parsed = toml::from_str(&format!("value = {text}"));
    let value = parsed
        .ok()
        .and_then(|mut table: Table| table.remove("value"));
    value.unwrap_or_else(|| Value::String(text.to_owned()))
}
