//! The synthetic scene that all figures are about.

use glam::{Quat, Vec3};
use splatting::{Camera, Gaussian, Gaussians, PixelClass, Pose, Rendered, TrainingView, ViewError};

/// A bumpy sphere of radius 0.75 m covered by discs about as far apart as they are wide, in Morton order.
pub fn model(count: usize) -> Gaussians {
    let spacing = 0.75 * (4.0 * std::f32::consts::PI / count as f32).sqrt();
    let mut state = 0x1234_5678_u64;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 24) as f32
    };
    let golden = std::f32::consts::PI * (3.0 - 5.0_f32.sqrt());
    let mut model: Gaussians = (0..count)
        .map(|i| {
            let z = 1.0 - 2.0 * (i as f32 + 0.5) / count as f32;
            let angle = golden * i as f32;
            let normal = Vec3::new((1.0 - z * z).sqrt() * angle.cos(), (1.0 - z * z).sqrt() * angle.sin(), z);
            let bump = 0.05 * ((8.0 * normal.x).sin() + (9.0 * normal.y).sin() + (7.0 * normal.z).cos());
            let opacity: f32 = random() + random() + random() - 1.5;
            Gaussian {
                mean: normal * (0.75 + bump),
                log_scales: Vec3::splat((spacing * (0.7 + 0.6 * random())).ln()),
                rotation: Quat::from_rotation_arc(Vec3::Z, normal),
                opacity_logit: 1.0 + 2.0 * opacity,
                sh: Gaussian::sh_from_color([random(), random(), random()]),
                id: i as u64,
                birth_round: 0,
            }
        })
        .collect();
    let order = model.morton_order();
    model.permute(&order);
    model
}

/// One of `of` cameras around the object, `distance_m` from its centre, aimed at `target`.
pub fn camera(index: usize, of: usize, distance_m: f32, target: Vec3) -> Camera {
    let angle = index as f32 / of as f32 * std::f32::consts::TAU;
    let eye = distance_m * Vec3::new(angle.cos() * 0.9, angle.sin() * 0.9, 0.436);
    Camera::from_hfov(Pose::IDENTITY, 1.204, 320, 240).look_at(eye, target, Vec3::Z)
}

/// A keyframe that is nearly what the model shows.
pub fn keyframe(camera: Camera, rendered: &Rendered) -> Result<TrainingView, ViewError> {
    let class: Vec<PixelClass> =
        rendered.alpha.iter().map(|&a| if a > 0.5 { PixelClass::Foreground } else { PixelClass::Free }).collect();
    let target: Vec<[f32; 3]> = rendered.color.iter().map(|c| c.map(|v| v * 0.9 + 0.05)).collect();
    TrainingView::new(camera, &target, &rendered.depth, &class)
}
