//! Section `[model]`: the size of the model and of the images it is trained and scored on.

use serde::{Deserialize, Serialize};

/// Section `[model]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// Most Gaussians; at the cap those that contribute least make room for new ones. Sizes the snapshot channel.
    pub max_gaussians: u32,
    /// Width of the images that are trained on, pixels: the capture's width over a whole number.
    pub width: u32,
    /// Height of the images that are trained on, pixels: the capture's height over the same number.
    pub height: u32,
}

impl Default for ModelConfig {
    fn default() -> Self {
        Self { max_gaussians: 500_000, width: 320, height: 240 }
    }
}

impl ModelConfig {
    /// Lists what is wrong, one sentence a problem: key, value found, what was expected.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if !(1_000..=4_000_000).contains(&self.max_gaussians) {
            problems.push(format!("model.max_gaussians is {}; expected 1000 to 4000000", self.max_gaussians));
        }
        for (key, value) in [("width", self.width), ("height", self.height)] {
            if !(16..=4096).contains(&value) {
                problems.push(format!("model.{key} is {value} pixels; expected 16 to 4096"));
            }
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_valid_and_impossible_sizes_are_named() {
        assert_eq!(ModelConfig::default().validate(), Vec::<String>::new());
        let bad = ModelConfig { max_gaussians: 0, width: 0, ..ModelConfig::default() };
        let problems = bad.validate();
        assert_eq!(problems.len(), 2);
        assert!(problems[0].contains("model.max_gaussians is 0") && problems[1].contains("model.width is 0"));
    }
}
