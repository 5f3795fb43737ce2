//! Standing an object on the ground: up axis, size, yaw, centred on the origin, lowest point on z = 0.

use glam::{Quat, Vec3};

use super::{MeshError, RawMesh, bounds_of};

/// Which axis of the file points up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum UpAxis {
    /// What the format implies: y for glTF, z for the others.
    #[default]
    Auto,
    /// y up, as most modelling programs have it.
    Y,
    /// z up, as surveys and CAD have it.
    Z,
}

/// Where and how large an object stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// The largest extent along an axis of the upright object before its yaw, metres.
    pub size_m: f64,
    /// Turn about the vertical, counter-clockwise seen from above, degrees.
    pub yaw_deg: f64,
    /// Which axis of the file points up.
    pub up: UpAxis,
}

impl Default for Placement {
    fn default() -> Self {
        Self { size_m: 1.5, yaw_deg: 0.0, up: UpAxis::Auto }
    }
}

impl Placement {
    /// Moves the vertices, and turns the normals, of a mesh whose format has `native_up`.
    pub(super) fn apply(&self, native_up: UpAxis, raw: &mut RawMesh) -> Result<(), MeshError> {
        if !(self.size_m.is_finite() && self.size_m > 1e-3 && self.size_m < 1e3) {
            let expected = "a size in metres between 0.001 and 1000";
            return Err(MeshError::BadPlacement { key: "size_m", value: self.size_m, expected });
        }
        if !self.yaw_deg.is_finite() {
            return Err(MeshError::BadPlacement {
                key: "yaw_deg",
                value: self.yaw_deg,
                expected: "a finite angle in degrees",
            });
        }
        let up = if self.up == UpAxis::Auto { native_up } else { self.up };
        let upright = match up {
            // Quarter turn about x: y becomes z, and what faced +z (the front in such files) faces -y, the south.
            UpAxis::Y => Quat::from_rotation_x(std::f32::consts::FRAC_PI_2),
            UpAxis::Z | UpAxis::Auto => Quat::IDENTITY,
        };
        let turned = |points: &mut Vec<Vec3>, rotation: Quat| points.iter_mut().for_each(|p| *p = rotation * *p);
        let center = |points: &mut Vec<Vec3>| {
            let (low, high) = bounds_of(points);
            // Halved before they are added: the sum of two large coordinates may overflow.
            let middle = low * 0.5 + high * 0.5;
            points.iter_mut().for_each(|p| *p -= middle);
            high - low
        };
        turned(&mut raw.positions, upright);
        let extent = center(&mut raw.positions).max_element();
        let scale = self.size_m as f32 / extent;
        raw.positions.iter_mut().for_each(|p| *p *= scale);
        let yaw = Quat::from_rotation_z(self.yaw_deg.to_radians() as f32);
        turned(&mut raw.positions, yaw);
        center(&mut raw.positions);
        let (low, _) = bounds_of(&raw.positions);
        raw.positions.iter_mut().for_each(|p| p.z -= low.z);
        if let Some(normals) = &mut raw.normals {
            normals.iter_mut().flatten().for_each(|n| *n = yaw * (upright * *n));
        }
        Ok(())
    }
}
