//! Voxels seen to be occupied, from the small depth images: what stands in the way besides the object.
//!
//! Each image adds one to a voxel in which a depth ends and takes one from every voxel that a ray passes, at most once an
//! image; two more hits than passes make it occupied. A second grid marks every voxel from whose centre an occupied one is
//! nearer than the clearance, so that a path is checked by one look-up a step.

use glam::{DVec3, IVec3, UVec3};

use super::depth::{DepthView, spread};

/// Edge of a voxel, metres.
pub const VOXEL_M: f64 = 0.2;
/// Rays taken of an image.
const RAYS: usize = 1200;
/// Depths beyond this say nothing, metres.
const FAR_M: f64 = 8.0;
const OCCUPIED: i8 = 2;
const MOST: i8 = 8;
const LEAST: i8 = -4;

/// The voxels of the mission volume.
#[derive(Debug, Clone)]
pub struct Occupancy {
    min_m: DVec3,
    size: UVec3,
    clearance_m: f64,
    counts: Vec<i8>,
    touched: Vec<u32>,
    blockers: Vec<u16>,
    images: u32,
    occupied: u32,
}

impl Occupancy {
    /// No voxel is occupied yet. At most 4 million voxels; a larger volume is covered in its lowest corner only.
    #[must_use]
    pub fn new(min_m: DVec3, max_m: DVec3, clearance_m: f64) -> Self {
        let cells = ((max_m - min_m) / VOXEL_M).ceil().clamp(DVec3::ONE, DVec3::splat(160.0));
        let size = cells.as_uvec3();
        let count = size.x as usize * size.y as usize * size.z as usize;
        Self {
            min_m,
            size,
            clearance_m,
            counts: vec![0; count],
            touched: vec![0; count],
            blockers: vec![0; count],
            images: 0,
            occupied: 0,
        }
    }

    /// Number of occupied voxels.
    #[must_use]
    pub fn occupied(&self) -> u32 {
        self.occupied
    }

    /// Whether an occupied voxel is nearer than the clearance to this point's voxel.
    #[must_use]
    pub fn blocks(&self, point_m: DVec3) -> bool {
        self.index(self.cell(point_m)).and_then(|at| self.blockers.get(at)).is_some_and(|&count| count > 0)
    }

    /// Takes an image in. `is_obstacle` says of a point whether it may be one (the object in its box and the ground are
    /// not: they are known). True when the set of occupied voxels changed.
    pub fn add(&mut self, view: &DepthView, is_obstacle: impl Fn(DVec3) -> bool) -> bool {
        self.images += 1;
        let stamp = self.images;
        let eye = view.world_from_camera.position_m;
        let mut passes: Vec<(DVec3, DVec3)> = Vec::new();
        let mut changed = false;
        for pixel in spread(view.depth_m.len(), RAYS) {
            let Some(depth) = view.depth_at(pixel) else { continue };
            let point = view.point_at(pixel, depth.min(FAR_M));
            // Hits come first: a voxel in which one ray ends and past which another grazes counts as hit.
            if depth < FAR_M
                && is_obstacle(point)
                && let Some(at) = self.index(self.cell(point))
            {
                changed |= self.count(at, stamp, 1);
            }
            passes.push((eye, point));
        }
        for (from, to) in passes {
            let length = (to - from).length() - 1.5 * VOXEL_M;
            let direction = (to - from).normalize_or_zero();
            let mut along = VOXEL_M;
            while along < length {
                if let Some(at) = self.index(self.cell(from + direction * along)) {
                    changed |= self.count(at, stamp, -1);
                }
                along += 0.8 * VOXEL_M;
            }
        }
        changed
    }

    fn count(&mut self, at: usize, stamp: u32, step: i8) -> bool {
        if self.touched.get(at).copied() == Some(stamp) {
            return false;
        }
        let (Some(touched), Some(count)) = (self.touched.get_mut(at), self.counts.get_mut(at)) else { return false };
        *touched = stamp;
        let before = *count >= OCCUPIED;
        *count = (*count + step).clamp(LEAST, MOST);
        let after = *count >= OCCUPIED;
        if before != after {
            self.occupied = if after { self.occupied + 1 } else { self.occupied.saturating_sub(1) };
            self.spread_block(at, after);
        }
        before != after
    }

    fn spread_block(&mut self, at: usize, add: bool) {
        let center = self.cell_at(at);
        // Half a voxel's diagonal more: the obstacle may be anywhere in its voxel, and so may the vehicle in its.
        let reach = self.clearance_m + VOXEL_M * 0.87;
        #[expect(clippy::cast_possible_truncation, reason = "a few voxels")]
        let steps = (reach / VOXEL_M).ceil() as i32;
        for dz in -steps..=steps {
            for dy in -steps..=steps {
                for dx in -steps..=steps {
                    let offset = IVec3::new(dx, dy, dz);
                    if offset.as_dvec3().length() * VOXEL_M > reach {
                        continue;
                    }
                    if let Some(blockers) = self.index(center + offset).and_then(|near| self.blockers.get_mut(near)) {
                        *blockers = if add { blockers.saturating_add(1) } else { blockers.saturating_sub(1) };
                    }
                }
            }
        }
    }

    fn cell(&self, point_m: DVec3) -> IVec3 {
        ((point_m - self.min_m) / VOXEL_M).floor().as_ivec3()
    }

    fn cell_at(&self, at: usize) -> IVec3 {
        let (x, y) = (self.size.x as usize, self.size.y as usize);
        #[expect(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "at most 160 a side")]
        let cell = IVec3::new((at % x) as i32, (at / x % y) as i32, (at / (x * y)) as i32);
        cell
    }

    fn index(&self, cell: IVec3) -> Option<usize> {
        let size = self.size.as_ivec3();
        let inside = cell.cmpge(IVec3::ZERO).all() && cell.cmplt(size).all();
        #[expect(clippy::cast_sign_loss, reason = "checked to lie inside")]
        let flat = || (cell.z as usize * size.y as usize + cell.y as usize) * size.x as usize + cell.x as usize;
        inside.then(flat)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared_types::frames::{Intrinsics, look_at};

    /// A view from the origin along x of a wall at `distance_m`.
    fn wall(distance_m: f32) -> DepthView {
        DepthView {
            stamp_ns: 0,
            world_from_camera: look_at(DVec3::new(0.0, 0.0, 2.0), DVec3::new(1.0, 0.0, 2.0)),
            intrinsics: Intrinsics::from_hfov(40, 30, 1.2),
            depth_m: vec![distance_m; 1200],
        }
    }

    #[test]
    fn a_wall_seen_twice_blocks_and_is_forgotten_once_seen_through() {
        let mut grid = Occupancy::new(DVec3::new(-5.0, -5.0, 0.0), DVec3::new(8.0, 5.0, 6.0), 0.72);
        let at_wall = DVec3::new(3.05, 0.0, 2.0);
        assert!(!grid.add(&wall(3.0), |_| true) && !grid.blocks(at_wall), "one image is not enough");
        assert!(grid.add(&wall(3.0), |_| true));
        assert!(grid.blocks(at_wall) && grid.blocks(at_wall - DVec3::X * 0.6));
        assert!(!grid.blocks(at_wall - DVec3::X * 1.3), "clear at a distance");
        for _ in 0..4 {
            grid.add(&wall(7.0), |_| true);
        }
        assert!(!grid.blocks(at_wall));
    }

    #[test]
    fn the_known_object_is_no_obstacle() {
        let mut grid = Occupancy::new(DVec3::new(-5.0, -5.0, 0.0), DVec3::new(8.0, 5.0, 6.0), 0.72);
        for _ in 0..5 {
            assert!(!grid.add(&wall(3.0), |point| point.x > 4.0));
        }
        assert_eq!(grid.occupied(), 0);
    }
}
