//! Memory of the services in flight: proportional set size, which counts shared memory once over all processes.

use std::collections::BTreeMap;

use shared_types::ServiceName;

/// Highest memory seen.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Memory {
    peak_bytes: BTreeMap<ServiceName, u64>,
    peak_total_bytes: u64,
}

impl Memory {
    /// Takes one sample: the PSS of every service at one instant.
    pub fn sample(&mut self, sizes: &[(ServiceName, u64)]) {
        for (service, bytes) in sizes {
            let peak = self.peak_bytes.entry(*service).or_default();
            *peak = (*peak).max(*bytes);
        }
        self.peak_total_bytes = self.peak_total_bytes.max(sizes.iter().map(|(_, bytes)| bytes).sum());
    }

    /// `<service>_pss_mb` and `total_pss_mb` (the highest sum at one instant, not the sum of the peaks), megabytes (10^6).
    /// Empty when nothing was sampled.
    #[must_use]
    pub fn megabytes(&self) -> BTreeMap<String, f64> {
        #[expect(clippy::cast_precision_loss, reason = "memory sizes are far below 2^53")]
        let megabytes = |bytes: u64| (bytes as f64 / 1e5).round() / 10.0;
        let mut all: BTreeMap<String, f64> =
            self.peak_bytes.iter().map(|(service, bytes)| (format!("{service}_pss_mb"), megabytes(*bytes))).collect();
        if !all.is_empty() {
            all.insert("total_pss_mb".to_owned(), megabytes(self.peak_total_bytes));
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_total_is_the_highest_sum_at_one_instant() {
        let mut memory = Memory::default();
        assert!(memory.megabytes().is_empty());
        memory.sample(&[(ServiceName::Trainer, 100_000_000), (ServiceName::Scorer, 10_000_000)]);
        memory.sample(&[(ServiceName::Trainer, 60_000_000), (ServiceName::Scorer, 40_000_000)]);
        let all = memory.megabytes();
        assert_eq!(all["trainer_pss_mb"], 100.0);
        assert_eq!(all["scorer_pss_mb"], 40.0);
        assert_eq!(all["total_pss_mb"], 110.0);
    }
}
