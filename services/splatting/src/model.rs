//! The Gaussian model: what a round trains and every renderer draws.
//!
//! Storage is blocks of 16 Gaussians by 14 rows (AoSoA): one 64-byte row holds one parameter of 16 Gaussians, which is
//! what a 16-lane projection or Adam step loads, and a block is contiguous, which is what the cache wants. The higher
//! spherical-harmonics bands are rows of their own beside these, none at degree 0: live training uses degree 0 (degree 1
//! brought nothing measurable), offline training up to 3.

use bytemuck::{Pod, Zeroable};
use glam::{Quat, Vec3};

use crate::edit::is_fresh;

/// Gaussians per block, the width of every SIMD path.
pub const LANES: usize = 16;
/// Parameters per Gaussian: mean 3, log scales 3, rotation 4, opacity logit 1, SH degree 0 3.
pub const ROWS: usize = 14;
/// Value of the degree-0 spherical-harmonics basis function: colour = 0.5 + SH_C0 * sh.
pub const SH_C0: f32 = 0.282_094_79;

/// Highest supported degree of spherical harmonics.
pub const SH_DEGREE_MAX: u8 = 3;
/// Coefficients per channel above degree 0 at [`SH_DEGREE_MAX`].
pub const SH_REST_MAX: usize = 15;

/// Coefficients per channel above degree 0: (degree + 1)² - 1.
pub const fn sh_rest_coefficients(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1) - 1
}

/// Rows of a block's higher bands: red, green, blue of each coefficient in turn.
pub(crate) const fn sh_rest_rows(degree: u8) -> usize {
    3 * sh_rest_coefficients(degree)
}

pub(crate) const ROW_MEAN: usize = 0;
pub(crate) const ROW_LOG_SCALE: usize = 3;
pub(crate) const ROW_ROTATION: usize = 6;
pub(crate) const ROW_OPACITY: usize = 10;
pub(crate) const ROW_SH: usize = 11;

/// One parameter of 16 Gaussians, aligned for the widest vector register.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(64))]
pub(crate) struct Lanes(pub [f32; LANES]);

/// All parameters (or all moments of one order) of 16 Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(64))]
pub(crate) struct Block(pub [Lanes; ROWS]);

impl Block {
    pub(crate) const ZERO: Self = Self([Lanes([0.0; LANES]); ROWS]);

    /// Copies all rows of one lane from another block.
    pub(crate) fn copy_lane(&mut self, lane: usize, from: &Self, from_lane: usize) {
        for (row, from_row) in self.0.iter_mut().zip(&from.0) {
            row.0[lane] = from_row.0[from_lane];
        }
    }
}

const _: () = assert!(size_of::<Block>() == ROWS * LANES * 4 && align_of::<Block>() == 64);

/// One Gaussian as a plain value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaussian {
    /// Centre in the world, metres.
    pub mean: Vec3,
    /// Natural logarithms of the standard deviations along the Gaussian's own axes, metres.
    pub log_scales: Vec3,
    /// Rotation from the Gaussian's axes to the world; need not be unit length (training lets it drift).
    pub rotation: Quat,
    /// Opacity before the logistic function.
    pub opacity_logit: f32,
    /// Degree-0 spherical-harmonics coefficients of red, green, blue: colour = 0.5 + [`SH_C0`] * sh.
    pub sh: [f32; 3],
    /// Stable identity, never reused in a mission.
    pub id: u64,
    /// Training round in which it was inserted.
    pub birth_round: u32,
}

impl Gaussian {
    /// SH coefficients of a plain colour in [0, 1].
    pub fn sh_from_color(color: [f32; 3]) -> [f32; 3] {
        color.map(|c| (c - 0.5) / SH_C0)
    }

    /// Colour as rendered (not clamped: a clamp would kill the gradient of a colour that overshot black).
    pub fn color(&self) -> [f32; 3] {
        self.sh.map(|s| 0.5 + SH_C0 * s)
    }

    /// Opacity in (0, 1).
    pub fn opacity(&self) -> f32 {
        1.0 / (1.0 + (-self.opacity_logit).exp())
    }

    /// Whether every parameter is finite and the rotation is not zero.
    pub fn is_finite(&self) -> bool {
        self.mean.is_finite()
            && self.log_scales.is_finite()
            && self.rotation.is_finite()
            && self.rotation.length_squared() > 0.0
            && self.opacity_logit.is_finite()
            && self.sh.iter().all(|s| s.is_finite())
    }

    pub(crate) fn row(&self) -> [f32; ROWS] {
        let (m, s, q) = (self.mean, self.log_scales, self.rotation);
        let [r, g, b] = self.sh;
        [m.x, m.y, m.z, s.x, s.y, s.z, q.x, q.y, q.z, q.w, self.opacity_logit, r, g, b]
    }
}

/// The model: an ordered list of Gaussians.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    blocks: Vec<Block>,
    /// [`sh_rest_rows`] of each block in turn.
    rest: Vec<Lanes>,
    sh_degree: u8,
    ids: Vec<u64>,
    birth_rounds: Vec<u32>,
}

impl Gaussians {
    /// An empty model of degree 0.
    pub fn new() -> Self {
        Self::default()
    }

    /// An empty model whose colours depend on the direction by spherical harmonics up to `degree`.
    ///
    /// # Panics
    /// Where `degree` is above [`SH_DEGREE_MAX`].
    pub fn with_sh_degree(degree: u8) -> Self {
        let mut model = Self::new();
        model.set_sh_degree(degree);
        model
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether the model holds nothing.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// Spherical-harmonics degree of the colours: 0 in live training, up to [`SH_DEGREE_MAX`] offline.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Changes the degree: coefficients of new bands are 0, those of dropped bands are lost.
    ///
    /// # Panics
    /// Where `degree` is above [`SH_DEGREE_MAX`].
    pub fn set_sh_degree(&mut self, degree: u8) {
        assert!(degree <= SH_DEGREE_MAX, "spherical harmonics of degree {degree}, above {SH_DEGREE_MAX}");
        self.rest = resize_rows(&self.rest, sh_rest_rows(self.sh_degree), sh_rest_rows(degree), self.blocks.len());
        self.sh_degree = degree;
    }

    /// Coefficients above degree 0 of the Gaussian at `index`, each red, green, blue: bands in order, and within band l
    /// the orders m from -l to l. Zero above the model's degree.
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn sh_rest(&self, index: usize) -> [[f32; 3]; SH_REST_MAX] {
        assert!(index < self.len(), "Gaussian {index} of {}", self.len());
        let mut out = [[0.0; 3]; SH_REST_MAX];
        for (row, lanes) in self.rest_rows(index / LANES).iter().enumerate() {
            out[row / 3][row % 3] = lanes.0[index % LANES];
        }
        out
    }

    /// Replaces the coefficients above degree 0; what is beyond the model's degree is left out.
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn set_sh_rest(&mut self, index: usize, coefficients: &[[f32; 3]; SH_REST_MAX]) {
        assert!(index < self.len(), "Gaussian {index} of {}", self.len());
        let rows = sh_rest_rows(self.sh_degree);
        let block = index / LANES;
        for (row, lanes) in self.rest[block * rows..(block + 1) * rows].iter_mut().enumerate() {
            lanes.0[index % LANES] = coefficients[row / 3][row % 3];
        }
    }

    /// The Gaussian at `index`.
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn get(&self, index: usize) -> Gaussian {
        assert!(index < self.len(), "Gaussian {index} of {}", self.len());
        let (block, lane) = (&self.blocks[index / LANES].0, index % LANES);
        let at = |row: usize| block[row].0[lane];
        Gaussian {
            mean: Vec3::new(at(0), at(1), at(2)),
            log_scales: Vec3::new(at(3), at(4), at(5)),
            rotation: Quat::from_xyzw(at(6), at(7), at(8), at(9)),
            opacity_logit: at(ROW_OPACITY),
            sh: [at(ROW_SH), at(ROW_SH + 1), at(ROW_SH + 2)],
            id: self.ids[index],
            birth_round: self.birth_rounds[index],
        }
    }

    /// Replaces the Gaussian at `index`.
    ///
    /// # Panics
    /// Where `index >= len()`, as a slice does.
    pub fn set(&mut self, index: usize, gaussian: &Gaussian) {
        assert!(index < self.len(), "Gaussian {index} of {}", self.len());
        let (block, lane) = (&mut self.blocks[index / LANES].0, index % LANES);
        for (row, value) in block.iter_mut().zip(gaussian.row()) {
            row.0[lane] = value;
        }
        self.ids[index] = gaussian.id;
        self.birth_rounds[index] = gaussian.birth_round;
    }

    /// Appends one Gaussian; its colour is the same from all directions until [`Gaussians::set_sh_rest`].
    pub fn push(&mut self, gaussian: &Gaussian) {
        if self.len().is_multiple_of(LANES) {
            self.blocks.push(Block::ZERO);
            let rows = sh_rest_rows(self.sh_degree);
            self.rest.resize(self.rest.len() + rows, Lanes([0.0; LANES]));
        }
        self.ids.push(gaussian.id);
        self.birth_rounds.push(gaussian.birth_round);
        self.set(self.len() - 1, gaussian);
    }

    /// Keeps the Gaussians for which `keep` says so, in order.
    pub fn retain(&mut self, mut keep: impl FnMut(usize) -> bool) {
        let kept: Vec<u32> = (0..self.len() as u32).filter(|&i| keep(i as usize)).collect();
        self.select(&kept);
    }

    /// Reorders: the new Gaussian `i` is the old Gaussian `order[i]`.
    ///
    /// # Panics
    /// Where `order` is not as long as the model or names an index outside of it.
    pub fn permute(&mut self, order: &[u32]) {
        assert_eq!(order.len(), self.len(), "a permutation has the length of the model");
        self.select(order);
    }

    /// The order that sorts the means along a Morton curve over their bounding box: neighbours in space become
    /// neighbours in memory, which is worth 6-17 % of a render. For [`Gaussians::permute`] and the optimiser's.
    pub fn morton_order(&self) -> Vec<u32> {
        let mut low = Vec3::INFINITY;
        let mut high = Vec3::NEG_INFINITY;
        for g in self.iter().filter(|g| g.mean.is_finite()) {
            low = low.min(g.mean);
            high = high.max(g.mean);
        }
        let scale = Vec3::splat(1023.0) / (high - low).max(Vec3::splat(1e-9));
        let mut keyed: Vec<(u32, u32)> = self
            .iter()
            .enumerate()
            .map(|(i, g)| {
                let cell = ((g.mean - low) * scale).clamp(Vec3::ZERO, Vec3::splat(1023.0));
                // `as` maps NaN to 0, so a broken mean sorts first instead of failing.
                let code = [cell.x, cell.y, cell.z]
                    .iter()
                    .enumerate()
                    .fold(0, |code, (axis, c)| code | spread_bits(*c as u32) << axis);
                (code, i as u32)
            })
            .collect();
        keyed.sort_unstable();
        keyed.into_iter().map(|(_, i)| i).collect()
    }

    /// All Gaussians in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Gaussian> + '_ {
        (0..self.len()).map(|i| self.get(i))
    }

    /// Whether every parameter of every Gaussian is finite.
    pub fn is_finite(&self) -> bool {
        self.iter().all(|g| g.is_finite()) && self.rest().iter().all(|row| row.0.iter().all(|c| c.is_finite()))
    }

    /// A model of degree `sh_degree` from blocks (and rows of the higher bands) for exactly as many Gaussians as there
    /// are ids and birth rounds.
    pub(crate) fn from_parts(
        blocks: Vec<Block>,
        (sh_degree, rest): (u8, Vec<Lanes>),
        ids: Vec<u64>,
        birth_rounds: Vec<u32>,
    ) -> Self {
        debug_assert!(blocks.len() == ids.len().div_ceil(LANES) && ids.len() == birth_rounds.len());
        debug_assert!(rest.len() == blocks.len() * sh_rest_rows(sh_degree));
        Self { blocks, rest, sh_degree, ids, birth_rounds }
    }

    pub(crate) fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    /// Ids of all Gaussians, in their order.
    pub(crate) fn ids(&self) -> &[u64] {
        &self.ids
    }

    pub(crate) fn blocks_mut_and_ids(&mut self) -> (&mut [Block], &[u64]) {
        (&mut self.blocks, &self.ids)
    }

    /// Rows of the higher bands of one block.
    pub(crate) fn rest_rows(&self, block: usize) -> &[Lanes] {
        let rows = sh_rest_rows(self.sh_degree);
        &self.rest[block * rows..(block + 1) * rows]
    }

    /// Blocks and rows of the higher bands, [`sh_rest_rows`] of each block in turn.
    pub(crate) fn parts_mut(&mut self) -> (&mut [Block], &mut [Lanes]) {
        (&mut self.blocks, &mut self.rest)
    }

    /// Rows of the higher bands of all blocks.
    pub(crate) fn rest(&self) -> &[Lanes] {
        &self.rest
    }

    /// Lowers opacity logits to `ceiling`.
    pub(crate) fn lower_opacities(&mut self, ceiling: f32) {
        for index in 0..self.len() {
            let logit = &mut self.blocks[index / LANES].0[ROW_OPACITY].0[index % LANES];
            if *logit > ceiling {
                *logit = ceiling;
            }
        }
    }

    fn select(&mut self, from: &[u32]) {
        debug_assert!(from.iter().all(|&i| (i as usize) < self.len()));
        self.blocks = select_lanes(&self.blocks, from);
        self.rest = select_row_lanes(&self.rest, sh_rest_rows(self.sh_degree), from);
        self.ids = from.iter().map(|&i| self.ids[i as usize]).collect();
        self.birth_rounds = from.iter().map(|&i| self.birth_rounds[i as usize]).collect();
    }
}

impl Extend<Gaussian> for Gaussians {
    fn extend<I: IntoIterator<Item = Gaussian>>(&mut self, gaussians: I) {
        for gaussian in gaussians {
            self.push(&gaussian);
        }
    }
}

impl FromIterator<Gaussian> for Gaussians {
    fn from_iter<I: IntoIterator<Item = Gaussian>>(gaussians: I) -> Self {
        let mut model = Self::new();
        model.extend(gaussians);
        model
    }
}

/// New blocks whose lane `i` is the old lane `from[i]`, or zero where that is a fresh source.
pub(crate) fn select_lanes(blocks: &[Block], from: &[u32]) -> Vec<Block> {
    let mut selected = vec![Block::ZERO; from.len().div_ceil(LANES)];
    for (to, &i) in from.iter().enumerate().filter(|(_, source)| !is_fresh(**source)) {
        let i = i as usize;
        selected[to / LANES].copy_lane(to % LANES, &blocks[i / LANES], i % LANES);
    }
    selected
}

/// New rows, `rows` for each block, whose lane `i` is the old lane `from[i]`, or zero where that is a fresh source.
pub(crate) fn select_row_lanes(old: &[Lanes], rows: usize, from: &[u32]) -> Vec<Lanes> {
    let mut selected = vec![Lanes([0.0; LANES]); from.len().div_ceil(LANES) * rows];
    if rows == 0 {
        return selected;
    }
    for (to, &i) in from.iter().enumerate().filter(|(_, source)| !is_fresh(**source)) {
        let i = i as usize;
        let (to_block, from_block) = (to / LANES * rows, i / LANES * rows);
        for row in 0..rows {
            selected[to_block + row].0[to % LANES] = old[from_block + row].0[i % LANES];
        }
    }
    selected
}

/// Rows of `blocks` blocks with `from` rows each, cut or filled with zeros to `to` rows each.
pub(crate) fn resize_rows(old: &[Lanes], from: usize, to: usize, blocks: usize) -> Vec<Lanes> {
    let mut new = vec![Lanes([0.0; LANES]); blocks * to];
    for block in 0..blocks {
        let kept = from.min(to);
        new[block * to..][..kept].copy_from_slice(&old[block * from..][..kept]);
    }
    new
}

/// Spreads the low 10 bits so that two zero bits follow each (one axis of a 3-D Morton code).
fn spread_bits(x: u32) -> u32 {
    let x = x & 0x3ff;
    let x = (x | x << 16) & 0x0300_00ff;
    let x = (x | x << 8) & 0x0300_f00f;
    let x = (x | x << 4) & 0x030c_30c3;
    (x | x << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gaussian(i: usize) -> Gaussian {
        let x = i as f32;
        Gaussian {
            mean: Vec3::new(x, -x, 0.5 * x),
            log_scales: Vec3::new(-3.0, -4.0 - x, -5.0),
            rotation: Quat::from_xyzw(0.1, 0.2, 0.3, 0.9 + x),
            opacity_logit: 0.1 * x,
            sh: [x, 2.0 * x, 3.0 * x],
            id: 1000 + i as u64,
            birth_round: i as u32 / 10,
        }
    }

    #[test]
    fn a_gaussian_comes_back_as_it_was_pushed() {
        let model: Gaussians = (0..37).map(gaussian).collect();
        assert_eq!(model.len(), 37);
        for i in 0..37 {
            assert_eq!(model.get(i), gaussian(i));
        }
        assert!(model.is_finite());
    }

    #[test]
    fn retain_keeps_order_and_identity() {
        let mut model: Gaussians = (0..50).map(gaussian).collect();
        model.retain(|i| i % 3 == 1);
        let expected: Vec<Gaussian> = (0..50).filter(|i| i % 3 == 1).map(gaussian).collect();
        assert_eq!(model.iter().collect::<Vec<_>>(), expected);
        model.push(&gaussian(99));
        assert_eq!(model.get(model.len() - 1), gaussian(99));
    }

    #[test]
    fn higher_bands_stay_with_their_gaussian() {
        let bands = |i: usize| std::array::from_fn(|k| [k as f32, i as f32, 0.5 * i as f32]);
        let mut model = Gaussians::with_sh_degree(2);
        for i in 0..40 {
            model.push(&gaussian(i));
            model.set_sh_rest(i, &bands(i));
        }
        model.retain(|i| i % 2 == 1);
        model.permute(&(0..20).rev().collect::<Vec<u32>>());
        let expected = |i: usize, coefficients: usize| {
            let mut bands = bands(39 - 2 * i);
            bands[coefficients..].fill([0.0; 3]);
            bands
        };
        assert!((0..20).all(|i| model.sh_rest(i) == expected(i, 8)));
        model.set_sh_degree(3);
        assert!((0..20).all(|i| model.sh_rest(i) == expected(i, 8)), "new bands are zero");
        model.set_sh_degree(1);
        assert!((0..20).all(|i| model.sh_rest(i) == expected(i, 3)), "dropped bands are gone");
        let mut broken = bands(0);
        broken[1][2] = f32::NAN;
        model.set_sh_rest(3, &broken);
        assert!(!model.is_finite());
    }

    #[test]
    fn morton_order_is_a_permutation_that_brings_neighbours_together() {
        // A zig-zag over two distant clusters: the order must visit one cluster and then the other.
        let mut model: Gaussians = (0..40)
            .map(|i| Gaussian {
                mean: Vec3::splat(if i % 2 == 0 { 0.0 } else { 9.0 } + 0.001 * i as f32),
                ..gaussian(i)
            })
            .collect();
        let order = model.morton_order();
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(i, &o)| i as u32 == o));
        model.permute(&order);
        assert!(model.iter().take(20).all(|g| g.mean.x < 1.0));
        assert!(model.iter().skip(20).all(|g| g.mean.x > 8.0));
    }

    #[test]
    fn a_nan_is_found() {
        let mut model: Gaussians = (0..5).map(gaussian).collect();
        model.set(3, &Gaussian { opacity_logit: f32::NAN, ..gaussian(3) });
        assert!(!model.is_finite());
        assert_eq!(model.morton_order().len(), 5);
    }
}
