//! A small random generator with a state that a checkpoint can hold.

use glam::Vec3;

/// SplitMix64 (Steele, Lea, Flood 2014): 64 bits of state, passes BigCrush, every seed is good.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Random(pub u64);

impl Random {
    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    /// Uniform in [0, 1), 53 bits.
    pub(crate) fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
    }

    /// Three independent standard normal numbers (Box-Muller).
    pub(crate) fn normal3(&mut self) -> Vec3 {
        let mut pair = || {
            // 1 - uniform is in (0, 1], so the logarithm is finite.
            let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
            let (sin, cos) = (std::f64::consts::TAU * self.uniform()).sin_cos();
            (radius * cos, radius * sin)
        };
        let ((x, y), (z, _)) = (pair(), pair());
        Vec3::new(x as f32, y as f32, z as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_have_the_moments_of_the_normal_distribution() {
        let mut random = Random(5);
        let samples: Vec<f64> = (0..40_000).flat_map(|_| random.normal3().to_array()).map(f64::from).collect();
        let moment = |power: i32| samples.iter().map(|x| x.powi(power)).sum::<f64>() / samples.len() as f64;
        // Standard errors of these means are below 0.003, 0.005, 0.012 and 0.03.
        assert!(moment(1).abs() < 0.012 && (moment(2) - 1.0).abs() < 0.02, "{} {}", moment(1), moment(2));
        assert!(moment(3).abs() < 0.05 && (moment(4) - 3.0).abs() < 0.12, "{} {}", moment(3), moment(4));
    }

    #[test]
    fn the_sequence_is_the_published_one() {
        // First outputs for the seed 1234567, as in the test vectors of Rosetta Code and of other implementations.
        let mut random = Random(1_234_567);
        assert_eq!(
            [random.bits(), random.bits(), random.bits()],
            [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423]
        );
    }
}
