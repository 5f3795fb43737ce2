//! Loading: defaults < preset < file < `--set`, every layer checked on its own so that errors name its lines.

use std::ops::Range;
use std::path::Path;

use toml::de::{DeTable, DeValue};

use super::Config;
use super::planner::GNSS_CLEARANCE_M;
use super::simulator::EstimatorName;

/// The presets: name and the TOML laid over the defaults.
pub const PRESETS: &[(&str, &str)] = &[
    ("default", include_str!("presets/default.toml")),
    ("paper", include_str!("presets/paper.toml")),
    ("quick", include_str!("presets/quick.toml")),
    ("tiny", include_str!("presets/tiny.toml")),
];

/// Why a configuration was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConfigError {
    /// No preset has that name.
    #[error("preset `{name}`: expected one of {}", preset_names())]
    UnknownPreset {
        /// The name found.
        name: String,
    },
    /// The file cannot be read.
    #[error("configuration file {path}: {reason}; name a readable TOML file, or begin with `vantage config > {path}`")]
    Unreadable {
        /// The file.
        path: String,
        /// The operating system's reason.
        reason: String,
    },
    /// The configuration of a mission, which `vantage fly` wrote whole, is gone.
    #[error(
        "{path} is {found}; expected the configuration that the mission was flown with: put the file back, or give the \
         folder of another mission"
    )]
    NoMission {
        /// The file.
        path: String,
        /// What is there.
        found: String,
    },
    /// A `--set` that is not `section.key=value`.
    #[error("--set {argument}: expected section.key=value, for example --set planner.keyframes=24")]
    BadSet {
        /// The argument found.
        argument: String,
    },
    /// Not TOML, an unknown key, or a value of the wrong type.
    #[error("{place}: {key}{message}")]
    Syntax {
        /// File and line, or the `--set`.
        place: String,
        /// `camera.width: `, or nothing where no key is known.
        key: String,
        /// What was found and what was expected.
        message: String,
    },
    /// Values that cannot be.
    #[error("{}", lines.join("\n"))]
    Impossible {
        /// One line each: place, key, value, expected.
        lines: Vec<String>,
    },
}

fn preset_names() -> String {
    PRESETS.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
}

/// TOML text that is laid over what is below it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layer {
    /// What errors call it: a path, `preset tiny`, `--set a.b=c`.
    pub name: String,
    /// The TOML.
    pub text: String,
    /// Whether line numbers mean something to the reader (a file).
    pub has_lines: bool,
}

impl Layer {
    /// The layer of a preset.
    ///
    /// # Errors
    /// When no preset has that name.
    pub fn of_preset(name: &str) -> Result<Self, ConfigError> {
        let (_, text) = PRESETS
            .iter()
            .find(|(preset, _)| *preset == name)
            .ok_or_else(|| ConfigError::UnknownPreset { name: name.to_owned() })?;
        Ok(Self { name: format!("preset {name}"), text: (*text).to_owned(), has_lines: true })
    }

    /// The layer of a file.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn of_file(path: &Path) -> Result<Self, ConfigError> {
        let name = path.display().to_string();
        let text = std::fs::read_to_string(path)
            .map_err(|error| ConfigError::Unreadable { path: name.clone(), reason: error.to_string() })?;
        Ok(Self { name, text, has_lines: true })
    }

    /// The layer of one `--set section.key=value`. The value is TOML where it is that and fits, else plain text, so that
    /// `planner.strategy=orbit24` needs no quotes.
    ///
    /// # Errors
    /// When there is no `=` or no section.
    pub fn of_set(argument: &str) -> Result<Self, ConfigError> {
        let bad = || ConfigError::BadSet { argument: argument.to_owned() };
        let (key, value) = argument.split_once('=').ok_or_else(bad)?;
        let (key, value) = (key.trim(), value.trim());
        let plain =
            |part: &str| !part.is_empty() && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
        if !key.contains('.') || !key.split('.').all(plain) {
            return Err(bad());
        }
        let as_toml = format!("{key} = {value}\n");
        let as_text = format!("{key} = {}\n", toml::Value::String(value.to_owned()));
        let fits = |text: &str| toml::from_str::<Config>(text).is_ok();
        let is_toml = !value.contains('\n') && DeTable::parse(&as_toml).is_ok();
        let text = if !is_toml || (!fits(&as_toml) && fits(&as_text)) { as_text } else { as_toml };
        Ok(Self { name: format!("--set {argument}"), text, has_lines: false })
    }

    /// "file:3" of a byte range of the text.
    fn place(&self, span: Option<&Range<usize>>) -> String {
        match span {
            Some(span) if self.has_lines => {
                let line = self.text.bytes().take(span.start).filter(|&b| b == b'\n').count() + 1;
                format!("{}:{line}", self.name)
            }
            _ => self.name.clone(),
        }
    }

    /// Parses the layer and refuses unknown keys and wrong types.
    fn check(&self) -> Result<toml::Table, ConfigError> {
        toml::from_str::<Config>(&self.text).map_err(|error| self.explain(&error))?;
        toml::from_str::<toml::Table>(&self.text).map_err(|error| self.explain(&error))
    }

    /// Turns the parser's error into one with place, key, and the nearest name for an unknown key.
    fn explain(&self, error: &toml::de::Error) -> ConfigError {
        let span = error.span();
        let path = span.as_ref().and_then(|span| self.key_at(span)).unwrap_or_default();
        let mut message = error.message().replace('\n', ", ");
        if message.starts_with("unknown field") {
            let names = quoted(&message);
            let (unknown, known) = names.split_first().map_or(("", &[][..]), |(first, rest)| (first.as_str(), rest));
            let hint = nearest(unknown, known).map_or(String::new(), |name| format!(" (did you mean `{name}`?)"));
            message = format!("unknown key{hint}, expected one of: {}", known.join(", "));
        }
        let key = if path.is_empty() { String::new() } else { format!("{path}: ") };
        ConfigError::Syntax { place: self.place(span.as_ref()), key, message }
    }

    /// The dotted key whose name or value covers a byte range: the deepest one.
    fn key_at(&self, span: &Range<usize>) -> Option<String> {
        let (table, _) = DeTable::parse_recoverable(&self.text);
        let mut best = None;
        walk(table.get_ref(), "", &mut |path, key, value| {
            let covers = |range: &Range<usize>| range.start <= span.start && span.end <= range.end;
            if covers(key) || covers(value) {
                best = Some(path.to_owned());
            }
        });
        best
    }

    /// "file:3" of a dotted key, when this layer sets it.
    fn place_of(&self, wanted: &str) -> Option<String> {
        let (table, _) = DeTable::parse_recoverable(&self.text);
        let mut place = None;
        walk(table.get_ref(), "", &mut |path, key, _| {
            if path == wanted {
                place = Some(self.place(Some(key)));
            }
        });
        place
    }
}

/// Takes a dotted path, and the bytes of its key and of its value.
type Visit<'a> = &'a mut dyn FnMut(&str, &Range<usize>, &Range<usize>);

/// Visits every key, parents first.
fn walk(table: &DeTable<'_>, prefix: &str, visit: Visit<'_>) {
    for (key, value) in table {
        let path = if prefix.is_empty() { key.get_ref().to_string() } else { format!("{prefix}.{}", key.get_ref()) };
        visit(&path, &key.span(), &value.span());
        if let DeValue::Table(inner) = value.get_ref() {
            walk(inner, &path, visit);
        }
    }
}

/// The parts of a message between backticks.
fn quoted(message: &str) -> Vec<String> {
    message.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// The known name nearest to an unknown one, if any is near: at most a third of its letters to edit.
fn nearest<'a>(unknown: &str, known: &'a [String]) -> Option<&'a String> {
    let near = (unknown.chars().count() / 3).max(2);
    known.iter().map(|name| (edits(unknown, name), name)).filter(|(cost, _)| *cost <= near).min().map(|(_, name)| name)
}

/// Levenshtein distance between two names.
fn edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().enumerate() {
        let mut diagonal = i;
        let mut left = i + 1;
        for (cb, above) in b.iter().zip(row.iter_mut().skip(1)) {
            let cost = (diagonal + usize::from(ca != *cb)).min(*above + 1).min(left + 1);
            diagonal = *above;
            left = cost;
            *above = cost;
        }
        if let Some(first) = row.first_mut() {
            *first = i + 1;
        }
    }
    row.last().copied().unwrap_or(0)
}

/// Lays one table over another: tables are merged, everything else replaced.
fn overlay(below: &mut toml::Table, above: toml::Table) {
    for (key, value) in above {
        match (below.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(value)) => overlay(inner, value),
            (_, value) => {
                below.insert(key, value);
            }
        }
    }
}

/// The configuration of a mission, from its `mission.toml`. Where that says nothing the defaults would be another mission's.
///
/// # Errors
/// [`ConfigError::NoMission`] where the file is missing or empty; as [`load`].
pub fn load_mission(path: &Path) -> Result<Config, ConfigError> {
    let gone = |found: &str| ConfigError::NoMission { path: path.display().to_string(), found: found.to_owned() };
    if !path.exists() {
        return Err(gone("missing"));
    }
    let layer = Layer::of_file(path)?;
    if layer.check()?.is_empty() {
        return Err(gone("empty"));
    }
    load(&[layer])
}

/// Lays the layers over the defaults, the last one on top, and refuses what cannot be.
///
/// # Errors
/// Unknown keys, wrong types and impossible values, each with the place where it was set.
pub fn load(layers: &[Layer]) -> Result<Config, ConfigError> {
    let mut merged = toml::Table::new();
    for layer in layers {
        overlay(&mut merged, layer.check()?);
    }
    let text = merged.to_string();
    let mut config: Config = toml::from_str(&text).map_err(|error| ConfigError::Syntax {
        place: "configuration".to_owned(),
        key: String::new(),
        message: error.message().to_owned(),
    })?;
    let chosen = layers.iter().any(|layer| layer.place_of("planner.clearance_m").is_some());
    if !chosen && config.simulator.estimator == EstimatorName::Gnss {
        config.planner.clearance_m = GNSS_CLEARANCE_M;
    }
    let lines: Vec<String> = config
        .problems()
        .into_iter()
        .map(|problem| {
            let set_at = layers.iter().rev().find_map(|layer| layer.place_of(&problem.key));
            let place = set_at.unwrap_or_else(|| "defaults".to_owned());
            format!("{place}: {} = {}: expected {}", problem.key, problem.value, problem.expected)
        })
        .collect();
    if lines.is_empty() { Ok(config) } else { Err(ConfigError::Impossible { lines }) }
}

/// The configuration of a preset.
///
/// # Errors
/// When no preset has that name.
pub fn preset(name: &str) -> Result<Config, ConfigError> {
    load(&[Layer::of_preset(name)?])
}

/// The text of mission.toml: reading it back with [`load`] gives the same configuration.
///
/// # Errors
/// When a number cannot be written as TOML (larger than 2^63 - 1).
pub fn to_toml(config: &Config) -> Result<String, ConfigError> {
    toml::to_string(config).map_err(|error| ConfigError::Impossible { lines: vec![format!("configuration: {error}")] })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> Layer {
        Layer { name: "m.toml".to_owned(), text: text.to_owned(), has_lines: true }
    }

    fn refusal(text: &str) -> String {
        load(&[file(text)]).expect_err("refused").to_string()
    }

    #[test]
    fn later_layers_win_key_by_key() {
        let config = load(&[
            file("[clock]\nspeed = 2.0\n[mission]\nseed = 3\nid = \"a\"\n"),
            Layer::of_set("mission.seed=9").expect("set"),
            Layer::of_set("clock.mode=wall").expect("set"),
        ])
        .expect("valid");
        assert_eq!((config.mission.seed, config.mission.id.as_str(), config.clock.speed), (9, "a", 2.0));
        assert_eq!(config.clock.mode, super::super::ClockMode::Wall);
    }

    #[test]
    fn an_unknown_key_is_named_with_its_line_and_the_nearest_one() {
        let message = refusal("[clock]\n\nsped = 2.0\n");
        assert!(
            message.starts_with("m.toml:3: clock.sped: unknown key (did you mean `speed`?), expected one of: "),
            "{message}"
        );
        let message = refusal("[clok]\nspeed = 2.0\n");
        assert!(message.starts_with("m.toml:1: clok: unknown key (did you mean `clock`?)"), "{message}");
    }

    #[test]
    fn a_wrong_type_is_named_with_its_line_and_what_was_expected() {
        let message = refusal("[mission]\nid = \"x\"\nseed = \"seven\"\n");
        assert!(message.starts_with("m.toml:3: mission.seed: ") && message.contains("expected u64"), "{message}");
        let message = refusal("[clock]\nmode = \"warp\"\n");
        assert!(message.contains("m.toml:2: clock.mode") && message.contains("lockstep"), "{message}");
    }

    #[test]
    fn an_impossible_value_is_named_where_it_was_last_set() {
        let layers = [file("[clock]\nspeed = -1.0\n"), Layer::of_set("clock.speed=-2").expect("set")];
        let message = load(&layers).expect_err("refused").to_string();
        assert_eq!(message, "--set clock.speed=-2: clock.speed = -2: expected a number from 0 to 1000");
        assert!(refusal("\n[clock]\nspeed = -1.0\n").starts_with("m.toml:3: clock.speed = -1"));
    }

    #[test]
    fn every_impossible_value_is_reported_at_once() {
        let message = refusal("[clock]\nspeed = -1.0\n[launch]\nlog_level = \"loud\"\n");
        assert!(message.contains("clock.speed") && message.contains("launch.log_level"), "{message}");
    }

    #[test]
    fn text_needs_no_quotes_on_the_command_line_even_when_it_looks_like_a_number() {
        let config = load(&[Layer::of_set("mission.id=42").expect("set")]).expect("valid");
        assert_eq!(config.mission.id, "42");
        for bad in ["speed=1", "clock.speed", "clock..speed=1", "=3", "a b.c=1"] {
            assert!(matches!(Layer::of_set(bad), Err(ConfigError::BadSet { .. })), "{bad}");
        }
    }

    #[test]
    fn broken_toml_is_refused_with_its_line() {
        assert!(refusal("[clock]\nspeed = = 2\n").starts_with("m.toml:2:"));
    }

    #[test]
    fn every_preset_loads_and_survives_being_written_and_read() {
        for (name, _) in PRESETS {
            let config = preset(name).unwrap_or_else(|error| panic!("preset {name}: {error}"));
            let text = to_toml(&config).expect("writable");
            assert_eq!(load(&[file(&text)]).expect("readable"), config, "preset {name}");
        }
        assert_eq!(preset("default").expect("default"), Config::default());
        let paper = preset("paper").expect("paper");
        assert_eq!(paper.trainer, super::super::TrainerConfig::paper());
        assert_eq!(paper.planner, super::super::PlannerConfig::paper());
    }

    #[test]
    fn gnss_keeps_a_greater_distance_unless_one_was_chosen() {
        let clearance = |sets: &[&str]| {
            let layers: Vec<Layer> = sets.iter().map(|set| Layer::of_set(set).expect("set")).collect();
            load(&layers).expect("valid").planner.clearance_m
        };
        assert_eq!(clearance(&["simulator.estimator=vio"]), 0.72);
        assert_eq!(clearance(&["simulator.estimator=gnss"]), 0.92);
        assert_eq!(clearance(&["simulator.estimator=gnss", "planner.clearance_m=0.8"]), 0.8);
    }

    #[test]
    fn edits_counts_letters() {
        assert_eq!((edits("speed", "sped"), edits("", "ab"), edits("kitten", "sitting")), (1, 2, 3));
    }
}
