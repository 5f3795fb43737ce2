//! Numbers that look random and depend on nothing but their arguments: the same for any number of threads and any order.

/// Scrambles 64 bits (the finaliser of SplitMix64).
#[must_use]
pub fn hash64(value: u64) -> u64 {
    let mut x = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// One hash of a seed and a counter.
#[must_use]
pub fn hash_pair(seed: u64, counter: u64) -> u64 {
    hash64(hash64(seed) ^ counter)
}

/// Uniform in [0, 1) from the upper bits of a hash.
#[must_use]
pub fn unit_from_hash(hash: u64) -> f64 {
    (hash >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
}

/// A standard normal deviate from a hash (Box-Muller on its two halves).
#[must_use]
pub fn normal_from_hash(hash: u64) -> f64 {
    let radius = (((hash >> 32) as f64 + 1.0) / 4_294_967_297.0).ln() * -2.0;
    let angle = (hash & 0xFFFF_FFFF) as f64 / 4_294_967_296.0 * std::f64::consts::TAU;
    radius.sqrt() * angle.cos()
}

/// A stream of uniform numbers, for code that draws one after the other.
#[derive(Debug, Clone)]
pub struct Stream {
    seed: u64,
    counter: u64,
}

impl Stream {
    /// The stream of a seed.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self { seed, counter: 0 }
    }

    /// The next number in [0, 1).
    pub fn next_unit(&mut self) -> f64 {
        self.counter += 1;
        unit_from_hash(hash_pair(self.seed, self.counter))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deviates_have_the_moments_of_their_distributions() {
        let n = 100_000;
        let uniform: f64 = (0..n).map(|i| unit_from_hash(hash_pair(7, i))).sum::<f64>() / n as f64;
        assert!((uniform - 0.5).abs() < 0.005);
        let normals: Vec<f64> = (0..n).map(|i| normal_from_hash(hash_pair(9, i))).collect();
        let mean = normals.iter().sum::<f64>() / n as f64;
        let variance = normals.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n as f64;
        assert!(mean.abs() < 0.01 && (variance - 1.0).abs() < 0.02, "{mean} {variance}");
        assert!(normals.iter().all(|x| x.is_finite()));
    }
}
