//! Section `[scorer]`: what scoring costs and how it is spread. What is scored and how (variance, weights, size) comes
//! with each request.

use serde::{Deserialize, Serialize};

use super::trainer::{BackendWord, DeclaredCost};

/// Section `[scorer]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ScorerConfig {
    /// Declared cost of one candidate on the simulated clock, milliseconds; `"auto"` measures this machine.
    pub ms_per_candidate: DeclaredCost,
    /// Worker threads; 0: one per core.
    pub threads: u32,
    /// What renders: `"auto"` (a GPU where there is a real one, else the CPU), `"cpu"` or `"gpu"`.
    pub backend: BackendWord,
    /// Name of the GPU, or a part of it (`vantage doctor` lists them); empty: the best that is not software.
    pub adapter: String,
    /// Pixels with less accumulated alpha than this are transparent: nothing is known there (0.1 in the paper).
    pub transparent_alpha: f64,
}

impl Default for ScorerConfig {
    fn default() -> Self {
        Self {
            ms_per_candidate: DeclaredCost::Fixed(4.0),
            threads: 0,
            backend: BackendWord::Auto,
            adapter: String::new(),
            transparent_alpha: 0.1,
        }
    }
}

impl ScorerConfig {
    /// Lists what is wrong, one sentence a problem: key, value found, what was expected.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if let DeclaredCost::Fixed(ms) = self.ms_per_candidate
            && !(ms.is_finite() && (0.0..=60_000.0).contains(&ms))
        {
            problems.push(format!("scorer.ms_per_candidate is {ms}; expected 0 to 60000 milliseconds, or \"auto\""));
        }
        if self.threads > 1024 {
            problems.push(format!("scorer.threads is {}; expected 0 (one per core) to 1024", self.threads));
        }
        if !(self.transparent_alpha > 0.0 && self.transparent_alpha < 1.0) {
            problems.push(format!(
                "scorer.transparent_alpha is {}; expected more than 0 and less than 1",
                self.transparent_alpha
            ));
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_valid_and_nonsense_is_named() {
        assert_eq!(ScorerConfig::default().validate(), Vec::<String>::new());
        let bad = ScorerConfig {
            ms_per_candidate: DeclaredCost::Fixed(f64::NAN),
            transparent_alpha: 0.0,
            ..ScorerConfig::default()
        };
        assert_eq!(bad.validate().len(), 2);
    }

    #[test]
    fn a_cost_is_a_number_or_the_word_auto() {
        let read = |text: &str| toml::from_str::<ScorerConfig>(text);
        assert_eq!(read("ms_per_candidate = 5").unwrap().ms_per_candidate, DeclaredCost::Fixed(5.0));
        assert!(matches!(read("ms_per_candidate = \"auto\"").unwrap().ms_per_candidate, DeclaredCost::Word(_)));
        assert!(read("ms_per_candidate = \"fast\"").is_err());
        assert!(read("candidates = 5").is_err());
    }
}
