//! Where the world has gone since the prior was taken: the prior's views again, laid onto the stored ones.
//!
//! An estimator that was started anew has put its origin elsewhere, by metres; gravity still tells which way is down, and
//! the compass where north is, so that what is looked for is a shift. First the highest point of every cell of the plan: over
//! all shifts of whole cells, ever smaller ones, the heights are laid on the stored ones, and those of the object count most.
//! Then both clouds become surfels (mean and normal of the points in a cell) and point-to-plane iterations (Chen and Medioni
//! 1992) on object and ground find the rest; along surfaces that all face one way, the heights' edges hold them. What is left
//! between the object's surfaces says whether it is the same object in the same attitude.

use glam::{DMat3, DVec2, DVec3};

use super::depth::DepthView;
use super::prior::Ground;

/// Points looked at of each image.
const POINTS: usize = 60_000;
/// Most that the world is looked for along each horizontal axis, metres.
const REACH_M: f64 = 5.0;
/// Most that a difference of heights counts, and what a place counts that is not seen, metres.
const STEP_M: f64 = 0.3;
const UNSEEN_M: f64 = 0.15;
/// What a place where the object stands counts, beside one of the ground.
const OBJECT_WEIGHT: f64 = 8.0;
/// Fewest points of a surfel, and fewest surfels of an object.
const SURFEL_POINTS: u32 = 4;
const OBJECT_SURFELS: usize = 8;
/// Height above the ground from which a surfel is the object's, metres.
const STANDS_M: f64 = 0.12;
/// Surfels farther apart than this do not belong together: in cells, at first and at last, and metres, in the residual.
const FAR: f64 = 2.0;
const NEAR: f64 = 1.0;
const APART_M: f64 = 0.3;
const ITERATIONS: u32 = 20;
/// What the heights' shift weighs beside a surfel.
const HELD: f64 = 0.02;
/// Share of the object's new surfels that must have found a stored one.
const LEAST_MATCHED: f64 = 0.5;

/// How new views lie on stored ones.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    /// What to add to positions of the new views to get the world of the stored ones, metres.
    pub shift_m: DVec3,
    /// Root mean square of what is then left between the object's surfaces, metres.
    pub residual_m: f64,
}

/// Finds the shift between views of one object: `stored` in the world of the prior, `seen` in the one of now. `around_m`
/// and `radius_m`: where the object stood. `None` where it is not seen, or not as itself.
#[must_use]
pub fn align(
    stored: &[&DepthView],
    seen: &[&DepthView],
    ground: &Ground,
    around_m: DVec3,
    radius_m: f64,
) -> Option<Fit> {
    let cell_m = stored.iter().chain(seen).map(|view| cell_of(view)).fold(0.1, f64::max);
    let (old, new) = (cloud(stored, around_m, radius_m + 1.0), cloud(seen, around_m, radius_m + 1.0 + REACH_M));
    let stands = |at: DVec3| at.z - ground.z_at(at) > STANDS_M;
    let rise_m = ground.z_at(around_m) - lowest(&new)?;
    let weight = |at: DVec3| if stands(at) { OBJECT_WEIGHT } else { 1.0 };
    let mut shift_m = coarse(&old, &new, rise_m, cell_m, around_m, radius_m + 0.5, weight)?;
    let near = |at: DVec3| (at + shift_m - around_m).truncate().length() <= radius_m + 0.5;
    let new: Vec<DVec3> = new.into_iter().filter(|point| near(*point)).collect();
    let (old, new) = (surfels(&old, cell_m), surfels(&new, cell_m));
    let (grid, anchor_m) = (Grid::new(&old, cell_m)?, shift_m);
    for step in 0..ITERATIONS {
        let share = f64::from(step) / f64::from(ITERATIONS - 1);
        let reach_m = cell_m * (FAR + (NEAR - FAR) * share);
        shift_m += improvement(&grid, &new, shift_m, anchor_m, reach_m)?;
    }
    // Only where the object stood: what else is near is not asked to have stayed.
    let object = new.iter().map(|surfel| surfel.mean_m + shift_m);
    let object: Vec<DVec3> =
        object.filter(|at| stands(*at) && (*at - around_m).truncate().length() <= radius_m).collect();
    let off = |at: &DVec3| grid.nearest(*at, APART_M).map(|known| (*at - known.mean_m).dot(known.normal).powi(2));
    let left: Vec<f64> = object.iter().filter_map(off).collect();
    let near = object.len();
    #[expect(clippy::cast_precision_loss, reason = "counts of surfels")]
    let (matched, count) = (left.len() as f64 / near.max(1) as f64, left.len() as f64);
    (left.len() >= OBJECT_SURFELS && matched >= LEAST_MATCHED)
        .then(|| Fit { shift_m, residual_m: (left.iter().sum::<f64>() / count).sqrt() })
}

/// A piece of a surface: the points of a cell.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Surfel {
    mean_m: DVec3,
    normal: DVec3,
    /// How flat it is: 1 is a plane, 0 spreads as much along the normal as along the surface, as pure noise does.
    flatness: f64,
}

/// Edge of cells that an image fills well: three pixels at its median depth.
fn cell_of(view: &DepthView) -> f64 {
    let mut depths: Vec<f64> = (0..view.depth_m.len()).filter_map(|index| view.depth_at(index)).collect();
    if depths.is_empty() {
        return 0.0;
    }
    let middle = depths.len() / 2;
    let depth_m = *depths.select_nth_unstable_by(middle, f64::total_cmp).1;
    (3.0 * depth_m / view.intrinsics.fx.max(1.0)).min(0.4)
}

fn cloud(views: &[&DepthView], around_m: DVec3, reach_m: f64) -> Vec<DVec3> {
    let near = |point: &DVec3| (*point - around_m).truncate().length() <= reach_m;
    views.iter().flat_map(|view| view.points(POINTS)).filter(near).collect()
}

fn surfels(points: &[DVec3], cell_m: f64) -> Vec<Surfel> {
    let mut cells = std::collections::BTreeMap::<[i64; 3], (DVec3, DMat3, u32)>::new();
    for point in points {
        let (sum, squares, count) = cells.entry(key(*point, cell_m)).or_insert((DVec3::ZERO, DMat3::ZERO, 0));
        *sum += *point;
        *squares += DMat3::from_cols(*point * point.x, *point * point.y, *point * point.z);
        *count += 1;
    }
    let of_cell = |(sum, squares, count): &(DVec3, DMat3, u32)| {
        if *count < SURFEL_POINTS {
            return None;
        }
        let mean_m = *sum / f64::from(*count);
        let outer = DMat3::from_cols(mean_m * mean_m.x, mean_m * mean_m.y, mean_m * mean_m.z);
        let covariance = *squares * f64::from(*count).recip() - outer;
        let normal = thinnest(covariance);
        let (least, all) =
            (normal.dot(covariance * normal), covariance.x_axis.x + covariance.y_axis.y + covariance.z_axis.z);
        let flatness = (1.0 - 2.0 * least / (all - least).max(1e-12)).clamp(0.0, 1.0);
        Some(Surfel { mean_m, normal, flatness })
    };
    cells.values().filter_map(of_cell).collect()
}

#[expect(clippy::cast_possible_truncation, reason = "metres of a mission's surroundings")]
fn key(point: DVec3, cell_m: f64) -> [i64; 3] {
    let cell = (point / cell_m).floor();
    [cell.x as i64, cell.y as i64, cell.z as i64]
}

/// Direction in which points spread least: the smallest eigenvector, by inverse iteration.
fn thinnest(covariance: DMat3) -> DVec3 {
    let inverse = (covariance + DMat3::from_diagonal(DVec3::splat(1e-8))).inverse();
    let mut direction = DVec3::new(0.32, 0.41, 0.85);
    for _ in 0..16 {
        direction = (inverse * direction).normalize_or(DVec3::Z);
    }
    direction
}

/// Height of the ground in a cloud: of what lies lowest, as in the prior's fit.
fn lowest(points: &[DVec3]) -> Option<f64> {
    let mut heights: Vec<f64> = points.iter().map(|point| point.z).collect();
    let at = heights.len() * 15 / 100;
    (!heights.is_empty()).then(|| *heights.select_nth_unstable_by(at, f64::total_cmp).1)
}

/// The shift of whole cells that lays the new heights best onto the stored ones, around the object.
fn coarse(
    old: &[DVec3],
    new: &[DVec3],
    rise_m: f64,
    cell_m: f64,
    around_m: DVec3,
    radius_m: f64,
    weight: impl Fn(DVec3) -> f64,
) -> Option<DVec3> {
    let mut shift_m = DVec3::Z * rise_m;
    // At last by single pixels.
    for (cell_m, reach_m) in [(2.0 * cell_m, REACH_M), (cell_m, 4.0 * cell_m), (cell_m / 3.0, 1.5 * cell_m)] {
        let (known, seen) = (Heights::new(old, cell_m)?, Heights::new(new, cell_m)?);
        let places: Vec<([i64; 2], DVec3, f64)> =
            known.within(around_m, radius_m).map(|(cell, at)| (cell, at, weight(at))).collect();
        let begin = key(shift_m, cell_m);
        #[expect(clippy::cast_possible_truncation, reason = "a few dozen")]
        let most = (reach_m / cell_m).ceil() as i64;
        let cost = |dx: i64, dy: i64| -> f64 {
            let of_place = |([x, y], at, weight): &([i64; 2], DVec3, f64)| {
                let off_m = seen.at([x - dx, y - dy]).map(|other| (other + shift_m.z - at.z).abs().min(STEP_M));
                off_m.unwrap_or(UNSEEN_M) * weight
            };
            places.iter().map(of_place).sum()
        };
        let mut best: Option<(f64, [i64; 2])> = None;
        for dx in begin[0] - most..=begin[0] + most {
            for dy in begin[1] - most..=begin[1] + most {
                let sum = cost(dx, dy);
                if best.is_none_or(|(least, _)| sum < least) {
                    best = Some((sum, [dx, dy]));
                }
            }
        }
        let (sum, [dx, dy]) = best?;
        #[expect(clippy::cast_precision_loss, reason = "whole cells")]
        let at = DVec2::new(dx as f64, dy as f64);
        let most = UNSEEN_M * places.iter().map(|(.., weight)| weight).sum::<f64>();
        if places.is_empty() || sum > most {
            return None;
        }
        let between = DVec2::new(
            lowest_between(cost(dx - 1, dy), sum, cost(dx + 1, dy)),
            lowest_between(cost(dx, dy - 1), sum, cost(dx, dy + 1)),
        );
        shift_m = ((at + between) * cell_m).extend(shift_m.z);
    }
    Some(shift_m)
}

/// Where between its neighbours the lowest of three costs lies: absolute differences grow evenly to both sides of it.
fn lowest_between(before: f64, at: f64, after: f64) -> f64 {
    let steepest = (before - at).max(after - at);
    if steepest > 0.0 { ((before - after) / (2.0 * steepest)).clamp(-0.5, 0.5) } else { 0.0 }
}

/// The highest point of every cell of the plan.
struct Heights {
    low: [i64; 2],
    size: [i64; 2],
    cell_m: f64,
    heights: Vec<f64>,
}

impl Heights {
    fn new(points: &[DVec3], cell_m: f64) -> Option<Self> {
        let keys = || points.iter().map(|point| key(*point, cell_m));
        let (mut low, mut size) = ([0; 2], [0; 2]);
        for axis in 0..2 {
            low[axis] = keys().map(|key| key[axis]).min()?;
            size[axis] = keys().map(|key| key[axis]).max()? - low[axis] + 1;
        }
        let count = usize::try_from(size[0] * size[1]).ok().filter(|count| *count < 1 << 22)?;
        let mut map = Self { low, size, cell_m, heights: vec![f64::NEG_INFINITY; count] };
        for (point, [x, y, _]) in points.iter().zip(keys()) {
            if let Some(height) = map.index([x, y]).and_then(|index| map.heights.get_mut(index)) {
                *height = height.max(point.z);
            }
        }
        Some(map)
    }

    fn index(&self, [x, y]: [i64; 2]) -> Option<usize> {
        let (x, y) = (x - self.low[0], y - self.low[1]);
        let inside = x >= 0 && y >= 0 && x < self.size[0] && y < self.size[1];
        inside.then(|| usize::try_from(y * self.size[0] + x).ok()).flatten()
    }

    fn at(&self, key: [i64; 2]) -> Option<f64> {
        self.index(key).and_then(|index| self.heights.get(index)).copied().filter(|height| height.is_finite())
    }

    /// Cells with a height whose middle is near a place.
    fn within(&self, around_m: DVec3, radius_m: f64) -> impl Iterator<Item = ([i64; 2], DVec3)> {
        let cells = (0..self.size[1]).flat_map(|y| (0..self.size[0]).map(move |x| [x, y]));
        cells.map(|[x, y]| [x + self.low[0], y + self.low[1]]).filter_map(move |cell| {
            #[expect(clippy::cast_precision_loss, reason = "whole cells")]
            let middle_m = DVec3::new(cell[0] as f64 + 0.5, cell[1] as f64 + 0.5, 0.0) * self.cell_m;
            let near = (middle_m - around_m).truncate().length() <= radius_m;
            near.then(|| self.at(cell)).flatten().map(|height| (cell, middle_m.with_z(height)))
        })
    }
}

/// One step of the fine search; `None` where nothing lies near.
fn improvement(grid: &Grid, new: &[Surfel], shift_m: DVec3, anchor_m: DVec3, reach_m: f64) -> Option<DVec3> {
    let (mut normal, mut right, mut count) = (DMat3::ZERO, DVec3::ZERO, 0.0);
    for surfel in new {
        let at = surfel.mean_m + shift_m;
        let Some(known) = grid.nearest(at, reach_m) else { continue };
        let away = known.mean_m - at;
        // A normal made of noise says nothing of where the surface is.
        let (n, weight) = (known.normal, known.flatness.powi(2));
        normal += DMat3::from_cols(n * n.x, n * n.y, n * n.z) * weight;
        right += n * n.dot(away) * weight;
        count += 1.0;
    }
    // Along surfaces that all face one way only their edges tell, as the heights did.
    let held = DVec3::new(HELD, HELD, 0.1 * HELD) * count + 1e-9;
    normal += DMat3::from_diagonal(held);
    right += held * (anchor_m - shift_m);
    (count >= 8.0).then(|| (normal.inverse() * right).clamp_length_max(reach_m))
}

/// Surfels by cell, for looking up what is near.
struct Grid {
    low: [i64; 3],
    size: [i64; 3],
    cell_m: f64,
    cells: Vec<Option<Surfel>>,
}

impl Grid {
    fn new(surfels: &[Surfel], cell_m: f64) -> Option<Self> {
        let keys: Vec<[i64; 3]> = surfels.iter().map(|surfel| key(surfel.mean_m, cell_m)).collect();
        let bound = |axis: usize| (keys.iter().map(|k| k[axis]).min(), keys.iter().map(|k| k[axis]).max());
        let (mut low, mut size) = ([0; 3], [0; 3]);
        for axis in 0..3 {
            let (Some(least), Some(most)) = bound(axis) else { return None };
            low[axis] = least;
            size[axis] = most - least + 1;
        }
        let count = usize::try_from(size.iter().product::<i64>()).ok().filter(|count| *count < 1 << 24)?;
        let mut grid = Self { low, size, cell_m, cells: vec![None; count] };
        for (surfel, key) in surfels.iter().zip(keys) {
            if let Some(cell) = grid.index(key).and_then(|index| grid.cells.get_mut(index)) {
                *cell = Some(*surfel);
            }
        }
        Some(grid)
    }

    fn index(&self, key: [i64; 3]) -> Option<usize> {
        let mut index = 0;
        for axis in (0..3).rev() {
            let at = key[axis] - self.low[axis];
            if at < 0 || at >= self.size[axis] {
                return None;
            }
            index = index * self.size[axis] + at;
        }
        usize::try_from(index).ok()
    }

    fn at(&self, key: [i64; 3]) -> Option<&Surfel> {
        self.index(key).and_then(|index| self.cells.get(index))?.as_ref()
    }

    fn nearest(&self, point_m: DVec3, reach_m: f64) -> Option<&Surfel> {
        #[expect(clippy::cast_possible_truncation, reason = "a few cells")]
        let most = (reach_m / self.cell_m).ceil() as i64;
        let [x, y, z] = key(point_m, self.cell_m);
        let mut best: Option<(f64, &Surfel)> = None;
        for dz in -most..=most {
            for dy in -most..=most {
                for dx in -most..=most {
                    let Some(surfel) = self.at([x + dx, y + dy, z + dz]) else { continue };
                    let distance = surfel.mean_m.distance(point_m);
                    if distance <= reach_m && best.is_none_or(|(least, _)| distance < least) {
                        best = Some((distance, surfel));
                    }
                }
            }
        }
        best.map(|(_, surfel)| surfel)
    }
}

#[cfg(test)]
#[path = "align_tests.rs"]
mod tests;
