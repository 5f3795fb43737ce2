//! Distances between points of a cloud, by a k-d tree.

use glam::Vec3;

/// Neighbours that count.
const NEIGHBOURS: usize = 3;
/// Points that are compared one by one.
const LEAF: usize = 8;

/// Root mean square of the distances from each point to the three nearest others; of as many as there are in clouds of
/// fewer than four points, and 0 for a single point. Points must be finite.
pub(crate) fn neighbour_distances(points: &[Vec3]) -> Vec<f32> {
    let mut tree = Tree { points, order: (0..points.len() as u32).collect(), axes: vec![0; points.len()] };
    tree.build(0, points.len());
    (0..points.len())
        .map(|i| {
            let mut nearest = Nearest([f32::INFINITY; NEIGHBOURS]);
            tree.search(i as u32, 0, points.len(), &mut nearest);
            let found = nearest.0.iter().filter(|d| d.is_finite());
            let (sum, count) = found.fold((0.0, 0.0_f32), |(sum, count), d| (sum + d, count + 1.0));
            (sum / count.max(1.0)).sqrt()
        })
        .collect()
}

/// Every part of `order` of more than [`LEAF`] points has its median along its widest axis in the middle, what lies
/// before along that axis before it, and what lies behind behind it.
struct Tree<'a> {
    points: &'a [Vec3],
    order: Vec<u32>,
    /// Axis of the part whose middle this is.
    axes: Vec<u8>,
}

impl Tree<'_> {
    fn build(&mut self, start: usize, end: usize) {
        if end - start <= LEAF {
            return;
        }
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for &i in &self.order[start..end] {
            low = low.min(self.points[i as usize]);
            high = high.max(self.points[i as usize]);
        }
        let axis = (high - low).max_position();
        let middle = start.midpoint(end);
        let points = self.points;
        self.order[start..end].select_nth_unstable_by(middle - start, |&a, &b| {
            points[a as usize][axis].total_cmp(&points[b as usize][axis]).then(a.cmp(&b))
        });
        self.axes[middle] = axis as u8;
        self.build(start, middle);
        self.build(middle + 1, end);
    }

    fn search(&self, from: u32, start: usize, end: usize, nearest: &mut Nearest) {
        if end - start <= LEAF {
            self.order[start..end].iter().for_each(|&to| self.compare(from, to, nearest));
            return;
        }
        let middle = start.midpoint(end);
        let (axis, at) = (self.axes[middle] as usize, self.order[middle]);
        let offset = self.points[from as usize][axis] - self.points[at as usize][axis];
        let (near, far) = ((start, middle), (middle + 1, end));
        let (near, far) = if offset < 0.0 { (near, far) } else { (far, near) };
        self.search(from, near.0, near.1, nearest);
        self.compare(from, at, nearest);
        if offset * offset < nearest.0[NEIGHBOURS - 1] {
            self.search(from, far.0, far.1, nearest);
        }
    }

    fn compare(&self, from: u32, to: u32, nearest: &mut Nearest) {
        if from != to {
            nearest.insert(self.points[from as usize].distance_squared(self.points[to as usize]));
        }
    }
}

/// Smallest squared distances, in order.
struct Nearest([f32; NEIGHBOURS]);

impl Nearest {
    fn insert(&mut self, distance: f32) {
        let mut carried = distance;
        for kept in &mut self.0 {
            if carried < *kept {
                std::mem::swap(kept, &mut carried);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::Random;

    fn one_by_one(points: &[Vec3]) -> Vec<f32> {
        let others = |i: usize| {
            let mut squares: Vec<f32> =
                (0..points.len()).filter(|&j| j != i).map(|j| points[i].distance_squared(points[j])).collect();
            squares.sort_by(f32::total_cmp);
            squares.truncate(3);
            squares
        };
        (0..points.len())
            .map(others)
            .map(|squares| (squares.iter().sum::<f32>() / squares.len().max(1) as f32).sqrt())
            .collect()
    }

    #[test]
    fn the_tree_finds_what_a_search_of_all_points_finds() {
        let mut random = Random(3);
        for count in [0, 1, 2, 3, 4, 9, 17, 500] {
            // A flat cluster, duplicates and a few points far away: nothing that a grid would like.
            let points: Vec<Vec3> = (0..count)
                .map(|i| {
                    let p =
                        Vec3::new(random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0), random.uniform(-0.01, 0.01));
                    match i % 20 {
                        0 => 100.0 * p,
                        1 => Vec3::splat(0.25),
                        _ => p,
                    }
                })
                .collect();
            let (got, want) = (neighbour_distances(&points), one_by_one(&points));
            assert!(got.iter().zip(&want).all(|(g, w)| (g - w).abs() <= 1e-6 * w), "{count}: {got:?} {want:?}");
        }
    }
}
