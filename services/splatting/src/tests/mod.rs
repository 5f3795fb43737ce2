//! The engine against the reference, and against itself on other instruction sets and thread counts.

pub(crate) mod densify;
mod densify_training;
mod edges;
pub(crate) mod forward;
pub(crate) mod gradients;
pub(crate) mod harmonics;
mod hostile;
mod mcmc;
mod statistics;
mod training;

use glam::{Quat, Vec3};

use crate::{Camera, Gaussian, Gaussians, Isa, PixelClass, Pose, TrainingView};

/// SplitMix64, for scenes that are the same on every machine.
pub struct Random(pub u64);

impl Random {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    /// Uniform in [low, high).
    pub fn uniform(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * ((self.bits() >> 40) as f32 / (1_u64 << 24) as f32)
    }

    fn vector(&mut self, low: f32, high: f32) -> Vec3 {
        Vec3::new(self.uniform(low, high), self.uniform(low, high), self.uniform(low, high))
    }
}

/// A camera of odd size that looks at the origin from about 2 m.
pub fn camera(width: u32, height: u32) -> Camera {
    Camera::from_hfov(Pose::IDENTITY, 1.0, width, height).look_at(
        Vec3::new(1.2, -1.5, 0.7),
        Vec3::new(0.05, 0.02, -0.03),
        Vec3::Z,
    )
}

/// Anisotropic Gaussians around the origin, some outside of the image, of all opacities.
pub fn scene(count: usize, seed: u64) -> Gaussians {
    let mut random = Random(seed);
    (0..count)
        .map(|i| Gaussian {
            mean: random.vector(-0.8, 0.8),
            log_scales: random.vector(-3.6, -1.6),
            rotation: Quat::from_xyzw(
                random.uniform(-1.0, 1.0),
                random.uniform(-1.0, 1.0),
                random.uniform(-1.0, 1.0),
                random.uniform(0.2, 1.0),
            ),
            opacity_logit: random.uniform(-3.0, 4.0),
            sh: random.vector(-1.5, 1.5).to_array(),
            id: i as u64,
            birth_round: 0,
        })
        .collect()
}

/// A view with random colours and depths near 2 m, all classes present, some depths missing.
pub fn random_view(camera: Camera, seed: u64) -> TrainingView {
    let mut random = Random(seed);
    let pixels = camera.pixels();
    let color: Vec<[f32; 3]> = (0..pixels).map(|_| random.vector(0.0, 1.0).to_array()).collect();
    let depth: Vec<f32> = (0..pixels).map(|i| if i % 9 == 0 { 0.0 } else { random.uniform(1.5, 2.5) }).collect();
    let class: Vec<PixelClass> = (0..pixels)
        .map(|i| match (i % camera.width as usize) * 4 / camera.width as usize {
            0 => PixelClass::Free,
            3 if i % 2 == 0 => PixelClass::Ignored,
            _ => PixelClass::Foreground,
        })
        .collect();
    TrainingView::new(camera, &color, &depth, &class).unwrap()
}

/// The instruction sets of this machine.
pub fn isas() -> Vec<Isa> {
    Isa::ALL.into_iter().filter(|isa| isa.is_available()).collect()
}
