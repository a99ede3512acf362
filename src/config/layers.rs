//! The layers of the configuration, one on the other: the lowest are the defaults, the highest is the command line.

use super::{
    Config, ConfigError, LayerPlaces, Origin, Overrides,
    layer::{Layer, leaves},
};
use serde::Deserialize;
use std::{collections::BTreeMap, path::PathBuf};
use toml::Value;

/// A configuration of which is known who said what.
#[derive(Clone, Debug)]
pub struct LayeredConfig {
    /// The configuration, checked.
    pub config: Config,
    /// The files that it was read from, the lowest first.
    pub files: Vec<PathBuf>,
    layers: Layer,
}

impl LayeredConfig {
    /// Lays the layers one on the other; each is checked together with those below it.
    ///
    /// # Errors
    /// For a file that cannot be read or parsed, an unknown key, and a value beyond its bound; the error names file and line,
    /// variable or command line, the key, its value and the bound.
    pub fn read(places: &LayerPlaces, overrides: &Overrides) -> Result<Self, ConfigError> {
        let mut layered = LayeredConfig {
            config: Config::default(),
            files: Vec::new(),
            layers: Layer::defaults()?,
        };
        for (path, text) in places.files()? {
            layered.lay(Layer::of_file(&path, &text)?, &path.display().to_string())?;
            layered.files.push(path);
        }
        let environment = Layer::of_environment(&places.environment)?;
        layered.lay(environment, "environment")?;
        let flags = Layer::of_overrides(overrides);
        layered.lay(flags, &Origin::CommandLine.to_string())?;
        Ok(layered)
    }

    fn lay(&mut self, layer: Layer, layer_name: &str) -> Result<(), ConfigError> {
        let said = layer.origins.clone();
        self.layers.lay(layer);
        let table = self.layers.table.clone();
        let read = Config::deserialize(table).map_err(|error| error.to_string());
        let checked = read.and_then(|config| config.validate().map(|()| config));
        self.config = checked.map_err(|what| {
            // The message begins with the key.
            let key = what.split([' ', '[', ':']).next().unwrap_or_default();
            let origin = said.get(key).map(Origin::to_string);
            ConfigError {
                origin: origin.unwrap_or_else(|| layer_name.to_owned()),
                what,
            }
        })?;
        Ok(())
    }

    /// Every key, with the tables' names before it, its value and where that comes from, by name.
    pub fn entries(&self) -> BTreeMap<String, (Value, Origin)> {
        let mut entries = BTreeMap::new();
        leaves(&self.layers.table, "", &mut |key, value| {
            let origin = self.layers.origins.get(&key).cloned();
            let origin = origin.unwrap_or(Origin::Default);
            entries.insert(key, (value.clone(), origin));
        });
        entries
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{ffi::OsString, fs, os::unix::ffi::OsStringExt, path::Path};

    /// A machine whose files are in a folder.
    struct Machine(tempfile::TempDir);

    impl Machine {
        fn new(files: &[(&str, &str)]) -> Self {
            let machine = Machine(tempfile::tempdir().unwrap());
            for (path, text) in files {
                let path = machine.path(path);
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                fs::write(path, text).unwrap();
            }
            machine
        }

        fn path(&self, path: &str) -> PathBuf {
            self.0.path().join(path)
        }

        fn places(&self, given: Option<&str>) -> LayerPlaces {
            let given = given.map(|path| self.path(path));
            let user = Path::new("/home/somebody/.config");
            LayerPlaces::under(self.0.path(), Some(user), given.as_deref())
        }
    }

    fn variables(pairs: &[(&str, &str)]) -> Vec<(OsString, OsString)> {
        let pair = |&(name, value): &(&str, &str)| (name.into(), value.into());
        pairs.iter().map(pair).collect()
    }

    const VOXEL: &str = "fusion.voxel_size_m";

    #[test]
    fn each_layer_lies_on_those_before_it_and_every_key_has_its_origin() {
        let voxel = |mm: u32| format!("# of this layer\n[fusion]\nvoxel_size_m = 0.00{mm}\n");
        let order = [
            "usr/share/relief/relief.toml",
            "etc/relief/relief.toml",
            "etc/relief/conf.d/10-first.toml",
            "etc/relief/conf.d/20-second.toml",
            "home/somebody/.config/relief/relief.toml",
            "given.toml",
        ];
        let mut files = vec![("etc/relief/conf.d/README", "no TOML".to_owned())];
        for (index, name) in order.iter().enumerate() {
            files.push((name, voxel(3 + index as u32)));
            let texts: Vec<_> = files
                .iter()
                .map(|(path, text)| (*path, text.as_str()))
                .collect();
            let machine = Machine::new(&texts);
            let given = (*name == "given.toml").then_some(*name);
            let read = LayeredConfig::read(&machine.places(given), &Overrides::default()).unwrap();
            assert_eq!(
                read.config.fusion.voxel_size_m,
                f64::from(3 + index as u32) / 1000.0
            );
            let entries = read.entries();
            assert_eq!(entries[VOXEL].1, Origin::File(machine.path(name), 3));
            assert_eq!(entries["fusion.depth_max_m"].1, Origin::Default);
            assert_eq!(read.files.len(), index + 1);
        }
    }

    #[test]
    fn the_environment_lies_on_the_files_and_the_flags_on_everything() {
        let machine = Machine::new(&[("given.toml", "[fusion]\nvoxel_size_m = 0.004\n")]);
        let places = machine
            .places(Some("given.toml"))
            .with_environment(variables(&[
                ("RELIEF_FUSION__ICP__ITERATIONS", "[1, 2, 3]"),
                ("RELIEF_FUSION__VOXEL_SIZE_M", "0.005"),
                ("RELIEF_FUSION__DEPTH_MAX_M", "3"),
                ("RELIEF_OBJECT__CROP", "object"),
                // None of the configuration's.
                ("RELIEF_CONFIG_ROOT", "/nowhere"),
                ("RELIEF_BENCH", "/nowhere"),
                ("RELIEF_SCAN", "a"),
                ("RELIEF_PAGE_URL", "http://127.0.0.1:8047"),
                ("PATH", "/bin"),
            ]));
        let overrides = Overrides {
            depth_max_m: Some(2.5),
            crop: Some(crate::refine::Crop::Box([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])),
            ..Overrides::default()
        };
        let read = LayeredConfig::read(&places, &overrides).unwrap();
        assert_eq!(read.config.fusion.icp.iterations, [1, 2, 3]);
        assert_eq!(read.config.fusion.voxel_size_m, 0.005);
        assert_eq!(read.config.fusion.depth_max_m, 2.5);
        assert_eq!(Some(read.config.object.crop), overrides.crop);
        let entries = read.entries();
        let variable = Origin::Environment("RELIEF_FUSION__VOXEL_SIZE_M".to_owned());
        assert_eq!(entries[VOXEL].1, variable);
        assert_eq!(entries["fusion.depth_max_m"].1, Origin::CommandLine);
        // What another kind of value has displaced is gone.
        assert!(!entries.contains_key("object.crop"));
        assert_eq!(entries["object.crop.box"].1, Origin::CommandLine);
    }

    #[test]
    fn errors_name_place_key_value_and_bound() {
        for (text, said) in [
            (
                "[fusion]\n\nvoxel_size_m = -1.0\n",
                "given.toml:3: fusion.voxel_size_m is -1, must be 0.0005 to 0.1",
            ),
            (
                "[fusion]\nvoxel_size = 0.1\n",
                "given.toml:2: fusion.voxel_size: unknown field `voxel_size`",
            ),
            (
                "[capture]\nrecord_depth_units_per_metre = 50000\n",
                "given.toml:2: capture.record_depth_units_per_metre is 50000, must be at most 32767.5",
            ),
            (
                "[fusion.icp]\niterations = \"many\"\n",
                "given.toml:2: fusion.icp.iterations: invalid type: string \"many\"",
            ),
            ("[fusion]\nvoxel_size_m = \n", "given.toml:2: "),
            (
                "\n[fusion.rolling_shutter]\nn = 1\n",
                "given.toml:2: fusion.rolling_shutter: invalid type: map, expected a boolean",
            ),
            (
                "[fusion]\nvoxel_size_m = 0.004\nvoxel_size_m = 0.005\n",
                "given.toml:3: duplicate key `voxel_size_m`",
            ),
            (
                "[capture]\nrecord_format = 3\n",
                "given.toml:2: capture.record_format: must be `mcap` or `folder`",
            ),
            (
                "[object]\n\ncrop.box = [0.0, 0.0, 0.5, 1.0, 1.0, 0.5]\n",
                "given.toml:3: object.crop.box: zmin is 0.5, must be below zmax, 0.5",
            ),
            ("[wheels]\nn = 4\n", "given.toml:1: unknown field `wheels`"),
        ] {
            let machine = Machine::new(&[("given.toml", text)]);
            let read =
                LayeredConfig::read(&machine.places(Some("given.toml")), &Overrides::default());
            let error = read.unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
        for (name, value, said) in [
            (
                "RELIEF_FUSION__VOXEL_SIZE_M",
                "7",
                "environment variable RELIEF_FUSION__VOXEL_SIZE_M: fusion.voxel_size_m is 7, must be",
            ),
            (
                "RELIEF_FUSION__WHEELS",
                "4",
                "environment variable RELIEF_FUSION__WHEELS: fusion.wheels: unknown field",
            ),
            (
                "RELIEF_FUSION_VOXEL_SIZE_M",
                "9",
                "environment variable RELIEF_FUSION_VOXEL_SIZE_M: names no key; RELIEF_FUSION__VOXEL_SIZE_M sets fusion.voxel_size_m",
            ),
            (
                "RELIEF_FUSION_ICP__ITERATIONS",
                "9",
                "environment variable RELIEF_FUSION_ICP__ITERATIONS: fusion_icp.iterations: unknown field",
            ),
            (
                "RELIEF_FUSION_ICP_ITERATION",
                "9",
                "environment variable RELIEF_FUSION_ICP_ITERATION: names no key; RELIEF_FUSION__ICP__ITERATIONS sets",
            ),
            (
                "RELIEF_FUSION",
                "{ voxel_size_m = 0.004 }",
                "environment variable RELIEF_FUSION: names no key; RELIEF_FUSION__",
            ),
            (
                "RELIEF_OBJECT__CROP__BOX",
                "[0.0, 0.0, 0.0, 1.0, 1.0, inf]",
                "environment variable RELIEF_OBJECT__CROP__BOX: object.crop.box: zmax is inf, must be finite",
            ),
            (
                "RELIEF_CAPTURE__RECORD_FORMAT",
                "3",
                "environment variable RELIEF_CAPTURE__RECORD_FORMAT: capture.record_format: must be `mcap` or",
            ),
        ] {
            let places = LayerPlaces::only(None).with_environment(variables(&[(name, value)]));
            let error = LayeredConfig::read(&places, &Overrides::default()).unwrap_err();
            assert!(error.to_string().starts_with(said), "{error}");
        }
        let no_text = OsString::from_vec(vec![b'0', 0xff]);
        let places = LayerPlaces::only(None)
            .with_environment(vec![("RELIEF_FUSION__VOXEL_SIZE_M".into(), no_text)]);
        let error = LayeredConfig::read(&places, &Overrides::default()).unwrap_err();
        let error = error.to_string();
        assert!(error.contains("RELIEF_FUSION__VOXEL_SIZE_M: "), "{error}");
        assert!(error.ends_with("is no UTF-8"), "{error}");
        let missing = LayerPlaces::only(Some(Path::new("/nowhere/at/all.toml")));
        let error = LayeredConfig::read(&missing, &Overrides::default()).unwrap_err();
        assert!(
            error.to_string().starts_with("/nowhere/at/all.toml: "),
            "{error}"
        );
    }

    #[test]
    fn without_a_layer_the_defaults_stand() {
        let machine = Machine::new(&[]);
        let read = LayeredConfig::read(&machine.places(None), &Overrides::default()).unwrap();
        assert_eq!(read.config, Config::default());
        assert!(read.files.is_empty());
        let entries = read.entries();
        assert!(
            entries.len() > 50
                && entries
                    .values()
                    .all(|(_, origin)| *origin == Origin::Default)
        );
    }
}
