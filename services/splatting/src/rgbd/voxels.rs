//! Where the model was seeded, and how finely: a sparse grid kept over the whole mission.

use std::collections::HashMap;

use glam::Vec3;

/// Edge of an insertion voxel, metres (A29): `factor` (R - 0.3 B) / f, the footprint of a training pixel (focal length
/// `focal_px`) on the near side of an object that fills most of the box.
#[must_use]
pub fn voxel_edge_m(factor: f64, radius_m: f64, box_size_m: f64, focal_px: f64) -> f64 {
    // A radius inside the object would be a broken request; the edge stays usable.
    factor * (radius_m - 0.3 * box_size_m).max(0.1 * radius_m) / focal_px
}

/// Voxels that were seeded, each with the footprint of the pixel that seeded it.
///
/// The map is only ever looked up, never iterated for a result.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelGrid {
    edge_m: f32,
    seeded: HashMap<[i32; 3], f32>,
}

impl VoxelGrid {
    /// An empty grid with this edge, metres.
    #[must_use]
    pub fn new(edge_m: f32) -> Self {
        Self { edge_m, seeded: HashMap::new() }
    }

    /// Edge of a voxel, metres.
    #[must_use]
    pub fn edge_m(&self) -> f32 {
        self.edge_m
    }

    /// Voxels seeded so far.
    #[must_use]
    pub fn len(&self) -> usize {
        self.seeded.len()
    }

    /// Whether nothing was seeded.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.seeded.is_empty()
    }

    /// Claims the voxel of a point for a pixel with this footprint (metres on the surface). True when the voxel was empty,
    /// or seeded from more than `reseed_ratio` times this footprint.
    pub fn claim(&mut self, point: Vec3, footprint_m: f32, reseed_ratio: f32) -> bool {
        let key = (point / self.edge_m).floor().as_ivec3().to_array();
        match self.seeded.get_mut(&key) {
            None => {
                self.seeded.insert(key, footprint_m);
                true
            }
            Some(before) if *before > reseed_ratio * footprint_m => {
                *before = footprint_m;
                true
            }
            Some(_) => false,
        }
    }

    /// All seeded voxels with their footprints, sorted by index: the grid's content for a checkpoint.
    #[must_use]
    pub fn sorted(&self) -> Vec<([i32; 3], f32)> {
        let mut entries: Vec<_> = self.seeded.iter().map(|(&key, &footprint)| (key, footprint)).collect();
        entries.sort_unstable_by_key(|entry| entry.0);
        entries
    }

    /// The grid with this content.
    #[must_use]
    pub fn from_entries(edge_m: f32, entries: impl IntoIterator<Item = ([i32; 3], f32)>) -> Self {
        Self { edge_m, seeded: entries.into_iter().collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_edge_of_the_design_s_example() {
        // B = 2 m, R = 2.5 m, 320 pixels over 1.204 rad: 9.8 mm.
        let focal = 160.0 / (1.204f64 / 2.0).tan();
        assert!((voxel_edge_m(1.2, 2.5, 2.0, focal) - 0.0098).abs() < 2e-4);
    }

    #[test]
    fn a_voxel_is_claimed_once_unless_it_was_seen_from_much_farther() {
        let mut grid = VoxelGrid::new(0.01);
        let point = Vec3::new(-0.001, 0.5, 2.0);
        assert!(grid.claim(point, 0.02, 2.0));
        assert!(!grid.claim(point + Vec3::new(-0.008, 0.001, 0.001), 0.02, 2.0), "the same voxel");
        assert!(grid.claim(point + Vec3::X * 0.01, 0.02, 2.0), "the next voxel");
        assert!(!grid.claim(point, 0.0101, 2.0), "not twice as fine");
        assert!(grid.claim(point, 0.0099, 2.0), "more than twice as fine");
        assert!(!grid.claim(point, 0.0099, 2.0));
        assert_eq!(grid.len(), 2);
        assert_eq!(VoxelGrid::from_entries(0.01, grid.sorted()), grid);
    }
}
