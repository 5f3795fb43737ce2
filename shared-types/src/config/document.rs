//! The commented configuration file that `vantage config` prints.
//!
//! The comments are the doc comments of the fields, read from the sections' own source, so that there is one place to
//! keep true.

use std::fmt::Write as _;

use super::{Config, ConfigError, load};

const SOURCES: &[&str] = &[
    include_str!("mod.rs"),
    include_str!("mission.rs"),
    include_str!("clock.rs"),
    include_str!("world.rs"),
    include_str!("camera.rs"),
    include_str!("model.rs"),
    include_str!("trainer.rs"),
    include_str!("scorer.rs"),
    include_str!("planner.rs"),
    include_str!("link.rs"),
    include_str!("simulator.rs"),
    include_str!("recorder.rs"),
    include_str!("launch.rs"),
];

/// A field of a configuration struct, as its source declares it.
struct Field {
    name: String,
    kind: String,
    doc: Vec<String>,
}

/// The public fields of `pub struct <name> { .. }`, in order, with their doc comments. Empty when no source has it.
fn fields_of(name: &str) -> Vec<Field> {
    let opening = format!("pub struct {name} {{");
    let mut fields = Vec::new();
    for source in SOURCES {
        let mut lines = source.lines().skip_while(|line| line.trim() != opening).skip(1);
        let mut doc = Vec::new();
        for line in lines.by_ref().map(str::trim) {
            if line == "}" {
                return fields;
            } else if let Some(text) = line.strip_prefix("///") {
                doc.push(text.trim().to_owned());
            } else if let Some((field, kind)) = line.strip_prefix("pub ").and_then(|rest| rest.split_once(':')) {
                let kind = kind.trim().trim_end_matches(',').rsplit("::").next().unwrap_or_default().to_owned();
                fields.push(Field { name: field.trim().to_owned(), kind, doc: core::mem::take(&mut doc) });
            }
        }
    }
    fields
}

/// A configuration as TOML with a comment above every key.
///
/// # Errors
/// When a number cannot be written as TOML.
pub fn commented(config: &Config) -> Result<String, ConfigError> {
    let table: toml::Table = toml::from_str(&load::to_toml(config)?)
        .map_err(|error| ConfigError::Impossible { lines: vec![format!("configuration: {error}")] })?;
    let mut out = String::from(
        "# The configuration of Vantage. Every key is optional; what is left out has the value of the preset `default`.\n\
         # Use it with `vantage fly --config FILE`; `--set section.key=value` changes one key.\n",
    );
    write_table(&mut out, "Config", "", &table);
    Ok(out)
}

/// Writes the values of a table, then its tables: TOML wants them in this order.
fn write_table(out: &mut String, kind: &str, path: &str, table: &toml::Table) {
    let fields = fields_of(kind);
    for field in &fields {
        match table.get(&field.name) {
            Some(toml::Value::Table(_)) => {}
            Some(value) => {
                write_doc(out, &field.doc);
                writeln!(out, "{} = {value}", field.name).ok();
            }
            None => {
                write_doc(out, &field.doc);
                writeln!(out, "# {} is not set", field.name).ok();
            }
        }
    }
    for field in &fields {
        if let Some(toml::Value::Table(inner)) = table.get(&field.name) {
            let inner_path = if path.is_empty() { field.name.clone() } else { format!("{path}.{}", field.name) };
            out.push('\n');
            if !path.is_empty() {
                write_doc(out, &field.doc);
            }
            writeln!(out, "[{inner_path}]").ok();
            if fields_of(&field.kind).is_empty() {
                // A map with keys of the user's own.
                write!(out, "{inner}").ok();
            } else {
                write_table(out, &field.kind, &inner_path, inner);
            }
        }
    }
}

fn write_doc(out: &mut String, doc: &[String]) {
    for line in doc {
        writeln!(out, "# {line}").ok();
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Layer, PRESETS, preset};
    use super::*;

    #[test]
    fn the_commented_file_parses_to_the_configuration_it_was_made_from() {
        for (name, _) in PRESETS {
            let config = preset(name).expect("preset");
            let text = commented(&config).expect("written");
            let layer = Layer { name: "commented".to_owned(), text, has_lines: true };
            assert_eq!(load(&[layer]).expect("parses"), config, "preset {name}");
        }
    }

    #[test]
    fn every_key_is_written_with_a_comment_above_it() {
        let text = commented(&Config::default()).expect("written");
        let lines: Vec<&str> = text.lines().collect();
        for pair in lines.windows(2) {
            let is_key = !pair[1].starts_with(['#', '[']) && pair[1].contains('=');
            assert!(!is_key || pair[0].starts_with("# "), "no comment above `{}`", pair[1]);
        }
        // The sections' own serialisation knows every key; none may be missing from the commented file.
        let plain = load::to_toml(&Config::default()).expect("written");
        let count = |text: &str| text.lines().filter(|line| line.contains(" = ") && !line.starts_with('#')).count();
        assert_eq!(count(&text), count(&plain));
        assert!(text.contains("# Seed of everything random.\nseed = 0\n"), "{text}");
    }
}
