//! Adam with a state that lives as long as the mission (A32), one step count per Gaussian, drawn Gaussians only.

use crate::edit::is_fresh;
use crate::model::{
    Block, Gaussians, LANES, Lanes, ROW_LOG_SCALE, ROW_OPACITY, ROW_ROTATION, ROW_SH, ROWS, SH_C0, SH_REST_MAX,
    resize_rows, select_lanes, select_row_lanes, sh_rest_rows,
};
use crate::settings::TrainingSettings;
use crate::simd::{Simd, build};

/// Moments and step counts of every Gaussian, in the order of the model.
///
/// What is done to the model's order is done here too: [`Optimiser::retain`] and [`Optimiser::permute`] with the same
/// argument. Gaussians appended to the model begin with zero moments at the next step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Optimiser {
    pub(crate) first: Vec<Block>,
    pub(crate) second: Vec<Block>,
    /// Moments of the higher bands, as many rows for each block as the model has.
    pub(crate) first_rest: Vec<Lanes>,
    pub(crate) second_rest: Vec<Lanes>,
    pub(crate) sh_degree: u8,
    pub(crate) steps: Vec<u32>,
}

impl Optimiser {
    /// No state yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Number of Gaussians with state.
    pub fn len(&self) -> usize {
        self.steps.len()
    }

    /// Whether there is no state.
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }

    /// Steps that the Gaussian at `index` has taken; 0 where it has no state yet.
    pub fn steps(&self, index: usize) -> u32 {
        self.steps.get(index).copied().unwrap_or(0)
    }

    /// Takes the shape of a model: zero state for Gaussians appended to it and for bands added to it, none for
    /// Gaussians cut from its end.
    pub fn fit(&mut self, model: &Gaussians) {
        let degree = model.sh_degree();
        if degree != self.sh_degree {
            let (from, to) = (sh_rest_rows(self.sh_degree), sh_rest_rows(degree));
            for rest in [&mut self.first_rest, &mut self.second_rest] {
                *rest = resize_rows(rest, from, to, self.first.len());
            }
            self.sh_degree = degree;
        }
        let length = model.len();
        if length < self.len() {
            self.retain(|i| i < length);
        }
        let blocks = length.div_ceil(LANES);
        self.first.resize(blocks, Block::ZERO);
        self.second.resize(blocks, Block::ZERO);
        for rest in [&mut self.first_rest, &mut self.second_rest] {
            rest.resize(blocks * sh_rest_rows(degree), Lanes([0.0; LANES]));
        }
        self.steps.resize(length, 0);
    }

    /// Keeps the state of the Gaussians for which `keep` says so, in order.
    pub fn retain(&mut self, mut keep: impl FnMut(usize) -> bool) {
        let kept: Vec<u32> = (0..self.len() as u32).filter(|&i| keep(i as usize)).collect();
        self.select(&kept);
    }

    /// Reorders: the new state `i` is the old state `order[i]`. Gaussians without state yet must have been given it
    /// by [`Optimiser::fit`].
    ///
    /// # Panics
    /// Where `order` is not as long as the state or names an index outside of it.
    pub fn permute(&mut self, order: &[u32]) {
        assert_eq!(order.len(), self.len(), "a permutation has the length of the state");
        self.select(order);
    }

    /// Takes the order of an edited list: the new state `i` is that of its source, or none yet where it is fresh.
    pub(crate) fn follow(&mut self, sources: &[u32]) {
        self.select(sources);
    }

    /// Forgets the moments of all opacities, not the step counts, as 3DGS does when it resets opacities.
    pub fn reset_opacities(&mut self) {
        for block in self.first.iter_mut().chain(&mut self.second) {
            block.0[ROW_OPACITY] = Lanes([0.0; LANES]);
        }
    }

    fn select(&mut self, from: &[u32]) {
        self.first = select_lanes(&self.first, from);
        self.second = select_lanes(&self.second, from);
        let rows = sh_rest_rows(self.sh_degree);
        self.first_rest = select_row_lanes(&self.first_rest, rows, from);
        self.second_rest = select_row_lanes(&self.second_rest, rows, from);
        self.steps = from.iter().map(|&i| if is_fresh(i) { 0 } else { self.steps[i as usize] }).collect();
    }
}

/// Constants of one step, the same for all Gaussians.
pub(crate) struct AdamStep<'a> {
    learning_rates: [f32; ROWS],
    learning_rate_rest: f32,
    betas: (f32, f32),
    epsilon: f32,
    log_scale_limits: (f32, f32),
    corrections: &'a Corrections,
}

impl<'a> AdamStep<'a> {
    pub(crate) fn new(settings: &TrainingSettings, corrections: &'a Corrections) -> Self {
        let mut learning_rates = [settings.lr_means; ROWS];
        learning_rates[ROW_LOG_SCALE..ROW_ROTATION].fill(settings.lr_log_scales);
        learning_rates[ROW_ROTATION..ROW_OPACITY].fill(settings.lr_rotations);
        learning_rates[ROW_OPACITY] = settings.lr_opacity;
        learning_rates[ROW_SH..].fill(settings.lr_sh);
        let limit = |sigma: f32| sigma.max(1e-9).ln();
        Self {
            learning_rates,
            learning_rate_rest: settings.lr_sh_rest,
            betas: settings.betas,
            epsilon: settings.epsilon,
            log_scale_limits: settings.sigma_limits_m.map_or((-20.0, 10.0), |(low, high)| (limit(low), limit(high))),
            corrections,
        }
    }

    /// One step for the given lanes of a block; returns the corrections of its moments, for the higher bands.
    #[inline(always)]
    pub(crate) fn apply<S: Simd>(
        &self,
        s: S,
        gradient: &[S::F; ROWS],
        lanes: S::M,
        block: &mut Block,
        (first, second, steps): (&mut Block, &mut Block, &mut [u32]),
    ) -> [S::F; 2] {
        let bits = s.bits(lanes);
        let (mut first_correction, mut second_correction) = ([1.0; LANES], [1.0; LANES]);
        for (lane, steps) in steps.iter_mut().enumerate() {
            if bits >> lane & 1 == 1 {
                *steps = steps.saturating_add(1);
                if let Some(&(c1, c2)) = self.corrections.table.get(*steps as usize) {
                    (first_correction[lane], second_correction[lane]) = (c1, c2);
                }
            }
        }
        let corrections = [s.load(&first_correction), s.load(&second_correction)];
        for row in 0..ROWS {
            let moments = (&mut first.0[row], &mut second.0[row]);
            let step = self.step(s, gradient[row], lanes, &corrections, moments);
            let old = s.load(&block.0[row].0);
            let mut new = s.fnma(s.splat(self.learning_rates[row]), step, old);
            if (ROW_LOG_SCALE..ROW_ROTATION).contains(&row) {
                let (low, high) = self.log_scale_limits;
                new = s.min(s.max(new, s.splat(low)), s.splat(high));
            }
            s.store(s.select(lanes, new, old), &mut block.0[row].0);
        }
        corrections
    }

    /// The step of the higher bands that goes with [`AdamStep::apply`]; `gradient` is that of all other parameters,
    /// `bands` are the basis functions. A band has no step count of its own: one that is evaluated later begins with
    /// zero moments at its Gaussian's count, as in 3DGS.
    #[inline(always)]
    pub(crate) fn apply_rest<S: Simd>(
        &self,
        s: S,
        (gradient, bands): (&[S::F; ROWS], &[S::F; SH_REST_MAX]),
        (lanes, corrections): (S::M, &[S::F; 2]),
        rest: &mut [Lanes],
        (first, second): (&mut [Lanes], &mut [Lanes]),
    ) {
        let color = build!(gradient[0]; 3; |k| s.mul(gradient[ROW_SH + k], s.splat(1.0 / SH_C0)));
        for (row, (rest, moments)) in rest.iter_mut().zip(first.iter_mut().zip(second)).enumerate() {
            let step = self.step(s, s.mul(bands[row / 3], color[row % 3]), lanes, corrections, moments);
            let old = s.load(&rest.0);
            let new = s.fnma(s.splat(self.learning_rate_rest), step, old);
            s.store(s.select(lanes, new, old), &mut rest.0);
        }
    }

    /// Moves the moments of one row and gives the step before its learning rate.
    #[inline(always)]
    fn step<S: Simd>(
        &self,
        s: S,
        g: S::F,
        lanes: S::M,
        corrections: &[S::F; 2],
        (first, second): (&mut Lanes, &mut Lanes),
    ) -> S::F {
        let (beta1, beta2) = (s.splat(self.betas.0), s.splat(self.betas.1));
        let old_m = s.load(&first.0);
        let old_v = s.load(&second.0);
        // b m + (1 - b) g = g + b (m - g)
        let m = s.fma(beta1, s.sub(old_m, g), g);
        let g2 = s.mul(g, g);
        let v = s.fma(beta2, s.sub(old_v, g2), g2);
        s.store(s.select(lanes, m, old_m), &mut first.0);
        s.store(s.select(lanes, v, old_v), &mut second.0);
        s.div(s.mul(m, corrections[0]), s.fma(s.sqrt(v), corrections[1], s.splat(self.epsilon)))
    }
}

/// By step count: 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t), until both are 1 in f32.
#[derive(Default)]
pub(crate) struct Corrections {
    betas: (f32, f32),
    table: Vec<(f32, f32)>,
}

impl Corrections {
    /// Computes the table where it is not the one of these betas.
    pub(crate) fn update(&mut self, betas: (f32, f32)) {
        if self.betas == betas && !self.table.is_empty() {
            return;
        }
        let (beta1, beta2) = (f64::from(betas.0), f64::from(betas.1));
        self.betas = betas;
        self.table = vec![(1.0, 1.0)];
        let (mut power1, mut power2) = (beta1, beta2);
        while (power1 > 1e-8 || power2 > 1e-8) && self.table.len() < 1 << 18 {
            self.table.push(((1.0 / (1.0 - power1)) as f32, (1.0 / (1.0 - power2).sqrt()) as f32));
            power1 *= beta1;
            power2 *= beta2;
        }
    }
}
