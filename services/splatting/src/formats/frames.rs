//! The coordinate frames of model files, and how a model is turned from one into another.
//!
//! | frame | right-handed axes | who uses it |
//! |---|---|---|
//! | world | x east, y north, z up; metres | models in memory, PLY and `.splat` as we write them |
//! | Y up | x right, y up, z towards the viewer ("RUB") | SPZ and glTF |
//!
//! PLY and `.splat` define no frame: ours are in the world frame (the PLY says so in a comment), those of others are read
//! as they are, whatever their up axis is. COLMAP's worlds, for example, have no up axis, and most viewers show a PLY as
//! if y pointed down ("RDF"), so that ours lies on its back there until it is turned.
//!
//! From the world to Y up is a turn by -90° about x: (x, y, z) becomes (x, z, -y), so east stays right, up becomes y, and
//! north points away from the viewer. A turn R takes means to R m, quaternions to q_R q, and spherical harmonics to those
//! whose colour in the direction R d is the old one in the direction d; scales, opacities and degree 0 stay.

use glam::{DMat3, DQuat, DVec3, Quat, Vec3};

use super::sh_rotation::ShRotation;
use crate::model::{Gaussian, Gaussians, SH_REST_MAX};

/// Takes world coordinates to Y up.
pub const Y_UP_FROM_WORLD: DMat3 = DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y);
/// Takes coordinates with Y up to the world.
pub const WORLD_FROM_Y_UP: DMat3 = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);

/// A rotation of a whole model.
#[derive(Clone, Debug)]
pub struct Turn {
    matrix: DMat3,
    quaternion: DQuat,
    bands: ShRotation,
}

impl Turn {
    /// By a rotation matrix: orthonormal, of determinant 1.
    pub fn new(matrix: DMat3) -> Self {
        Self { matrix, quaternion: DQuat::from_mat3(&matrix).normalize(), bands: ShRotation::new(matrix) }
    }

    /// From the world frame to Y up. Means that are turned and turned back are the same to the bit.
    pub fn world_to_y_up() -> Self {
        Self::new(Y_UP_FROM_WORLD)
    }

    /// From Y up to the world frame.
    pub fn y_up_to_world() -> Self {
        Self::new(WORLD_FROM_Y_UP)
    }

    /// The way back.
    pub fn inverse(&self) -> Self {
        let matrix = self.matrix.transpose();
        Self { matrix, quaternion: self.quaternion.conjugate(), bands: ShRotation::new(matrix) }
    }

    /// The matrix of the turn.
    pub fn matrix(&self) -> DMat3 {
        self.matrix
    }

    /// A point after the turn.
    pub fn mean(&self, mean: Vec3) -> Vec3 {
        (self.matrix * mean.as_dvec3()).as_vec3()
    }

    /// A rotation from a Gaussian's axes after the turn; of the same length as before, or of length 1 where f32 has not
    /// that length in other directions.
    pub fn rotation(&self, rotation: Quat) -> Quat {
        let turned = self.quaternion * rotation.as_dquat();
        let single = turned.as_quat();
        if single.is_finite() { single } else { turned.normalize().as_quat() }
    }

    /// Coefficients above degree 0 after the turn.
    pub fn bands(&self, rest: &[[f32; 3]; SH_REST_MAX]) -> [[f32; 3]; SH_REST_MAX] {
        self.bands.apply(rest)
    }

    /// Coefficient `k` above degree 0 after the turn.
    ///
    /// # Panics
    /// Where `k` is not below [`SH_REST_MAX`].
    pub fn band_coefficient(&self, k: usize, rest: &[[f32; 3]; SH_REST_MAX]) -> [f32; 3] {
        self.bands.coefficient(k, rest)
    }

    /// A Gaussian after the turn, but for its higher bands, which are [`Turn::bands`].
    pub fn gaussian(&self, gaussian: &Gaussian) -> Gaussian {
        Gaussian { mean: self.mean(gaussian.mean), rotation: self.rotation(gaussian.rotation), ..*gaussian }
    }

    /// Turns a whole model about the origin.
    pub fn apply(&self, model: &mut Gaussians) {
        for index in 0..model.len() {
            model.set(index, &self.gaussian(&model.get(index)));
            if model.sh_degree() > 0 {
                model.set_sh_rest(index, &self.bands(&model.sh_rest(index)));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::tests::model;

    /// Covariance of a Gaussian in its frame, m².
    fn covariance(g: &Gaussian) -> DMat3 {
        let axes = DMat3::from_quat(g.rotation.as_dquat().normalize());
        let scaled = axes * DMat3::from_diagonal((2.0 * g.log_scales.as_dvec3()).exp());
        scaled * axes.transpose()
    }

    #[test]
    fn up_is_up_and_north_is_away() {
        let turn = Turn::world_to_y_up();
        assert_eq!(turn.mean(Vec3::Z), Vec3::Y);
        assert_eq!(turn.mean(Vec3::Y), Vec3::NEG_Z);
        assert_eq!(turn.mean(Vec3::X), Vec3::X);
        assert_eq!(WORLD_FROM_Y_UP * Y_UP_FROM_WORLD, DMat3::IDENTITY);
        let axis = turn.rotation(Quat::IDENTITY) * Vec3::Z;
        assert!((axis - Vec3::Y).length() < 1e-6, "the quaternion is that of the matrix: {axis}");
    }

    #[test]
    fn shapes_and_colours_turn_with_the_means() {
        let before = model(20, 3, 5);
        for turn in [Turn::world_to_y_up(), Turn::new(DMat3::from_rotation_y(0.7) * DMat3::from_rotation_x(2.0))] {
            let mut after = before.clone();
            turn.apply(&mut after);
            let eye = Vec3::new(0.4, -2.0, 1.1);
            for i in 0..before.len() {
                let rotated = turn.matrix * covariance(&before.get(i)) * turn.matrix.transpose();
                assert!(rotated.abs_diff_eq(covariance(&after.get(i)), 1e-6));
                let (old, new) = (before.color_from(i, eye), after.color_from(i, turn.mean(eye)));
                assert!(old.iter().zip(new).all(|(a, b)| (a - b).abs() < 1e-5), "{i}: {old:?}, {new:?}");
            }
            turn.inverse().apply(&mut after);
            for (a, b) in before.iter().zip(after.iter()) {
                assert!((a.mean - b.mean).length() < 1e-6 && (a.rotation - b.rotation).length() < 1e-6);
            }
        }
    }
}
