//! Section `[world]`: what stands in the simulated world, and how it is rendered.

use serde::{Deserialize, Serialize};

/// Which axis of a mesh points up.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MeshUp {
    /// What the format implies: y for glTF, z for the others.
    #[default]
    Auto,
    /// y.
    Y,
    /// z.
    Z,
}

/// Section `[world]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldConfig {
    /// `rock` for the procedural rock, else the path of a mesh (OBJ, PLY, STL, glTF).
    pub object: String,
    /// Largest extent of the object, metres.
    pub size_m: f64,
    /// Turn of the object about the vertical, degrees.
    pub yaw_deg: f64,
    /// Which axis of the mesh points up: auto, y or z.
    pub up: MeshUp,
    /// Seed of the rock, of procedural albedo and of the ground.
    pub seed: u64,
    /// Where the sun stands, clockwise from north, degrees.
    pub sun_azimuth_deg: f64,
    /// Height of the sun above the horizon, degrees.
    pub sun_elevation_deg: f64,
    /// Colour samples along each edge of a pixel of a captured image: 2 is 4 samples a pixel, 4 is 16.
    pub samples_per_edge: u32,
    /// Standard deviation of the depth sensor's noise at 1 m, metres; grows with the square of the depth. 0: none.
    pub depth_noise_m: f64,
    /// Threads of the renderer; 0: one for each core.
    pub threads: usize,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self {
            object: "rock".to_owned(),
            size_m: 1.5,
            yaw_deg: 0.0,
            up: MeshUp::Auto,
            seed: 1,
            sun_azimuth_deg: 215.0,
            sun_elevation_deg: 48.0,
            samples_per_edge: 2,
            depth_noise_m: 0.0,
            threads: 0,
        }
    }
}

impl WorldConfig {
    /// Values that cannot be, each as "key is VALUE; expected WHAT".
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut within = |key: &str, value: f64, low: f64, high: f64| {
            if !(value.is_finite() && (low..=high).contains(&value)) {
                problems.push(format!("{key} is {value}; expected a number from {low} to {high}"));
            }
        };
        within("world.size_m", self.size_m, 0.05, 20.0);
        within("world.yaw_deg", self.yaw_deg, -360.0, 360.0);
        within("world.sun_azimuth_deg", self.sun_azimuth_deg, -360.0, 360.0);
        within("world.sun_elevation_deg", self.sun_elevation_deg, 5.0, 90.0);
        within("world.samples_per_edge", f64::from(self.samples_per_edge), 1.0, 8.0);
        within("world.depth_noise_m", self.depth_noise_m, 0.0, 0.1);
        if self.object.is_empty() {
            problems.push("world.object is empty; expected `rock` or the path of a mesh".to_owned());
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_valid_and_nonsense_is_named() {
        assert!(WorldConfig::default().validate().is_empty());
        let wrong = WorldConfig { size_m: 0.0, object: String::new(), ..WorldConfig::default() };
        let problems = wrong.validate();
        assert!(problems[0].contains("size_m is 0") && problems[1].contains("object is empty"), "{problems:?}");
    }
}
