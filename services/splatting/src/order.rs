//! The order of views within a round: uniform replay, shuffled anew each time all views were seen, from a seed.

/// A small generator with a state that fits in a checkpoint (SplitMix64).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Random {
    state: u64,
}

impl Random {
    /// A generator that gives the same numbers for the same seed.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// Its whole state, for [`Random::new`] to go on from.
    #[must_use]
    pub fn state(&self) -> u64 {
        self.state
    }

    /// The next 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below `end` (0 where `end` is 0). The bias of the multiplication is below 2^-32.
    pub fn below(&mut self, end: u32) -> u32 {
        ((u64::from(end) * (self.next_u64() >> 32)) >> 32) as u32
    }
}

/// Most views of an order that is resumed: a pass over all of them is a list in memory.
const MOST_VIEWS: u32 = 1 << 22;

/// Uniform replay over `views` views: every view once, in random order, before any comes again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ViewOrder {
    random: Random,
    views: u32,
    /// Views still to come in this pass, last first.
    left: Vec<u32>,
}

impl ViewOrder {
    /// The order for a round.
    #[must_use]
    pub fn new(seed: u64, views: u32) -> Self {
        Self { random: Random::new(seed), views, left: Vec::new() }
    }

    /// An order that goes on where another stopped: its [`Random::state`], its views, and those left. `None` where no order
    /// can have stopped so: more views left than there are, one that there is not, or more than 4 million views.
    #[must_use]
    pub fn resume(state: u64, views: u32, left: Vec<u32>) -> Option<Self> {
        let fits = views <= MOST_VIEWS && left.len() <= views as usize && left.iter().all(|&view| view < views);
        fits.then(|| Self { random: Random::new(state), views, left })
    }

    /// What [`ViewOrder::resume`] needs: state, views, views left.
    #[must_use]
    pub fn parts(&self) -> (u64, u32, &[u32]) {
        (self.random.state(), self.views, &self.left)
    }

    /// The next view's index; `None` without views.
    pub fn next_view(&mut self) -> Option<u32> {
        if self.left.is_empty() {
            self.left = (0..self.views).collect();
            for i in (1..self.views).rev() {
                let j = self.random.below(i + 1);
                self.left.swap(i as usize, j as usize);
            }
        }
        self.left.pop()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pass_holds_every_view_once_in_another_order() {
        let mut order = ViewOrder::new(7, 48);
        let pass = |order: &mut ViewOrder| -> Vec<u32> { (0..48).map(|_| order.next_view().unwrap()).collect() };
        let (first, second) = (pass(&mut order), pass(&mut order));
        assert_ne!(first, second);
        for mut pass in [first.clone(), second] {
            pass.sort_unstable();
            assert!(pass.iter().copied().eq(0..48));
        }
        assert_eq!(pass(&mut ViewOrder::new(7, 48)), first, "the same seed");
        assert_ne!(pass(&mut ViewOrder::new(8, 48)), first, "another seed");
        assert_eq!(ViewOrder::new(1, 0).next_view(), None);
    }

    #[test]
    fn an_order_goes_on_from_its_parts() {
        let mut order = ViewOrder::new(3, 5);
        for _ in 0..7 {
            order.next_view();
        }
        let (state, views, left) = order.parts();
        let mut resumed = ViewOrder::resume(state, views, left.to_vec()).unwrap();
        for _ in 0..23 {
            assert_eq!(resumed.next_view(), order.next_view());
        }
    }

    #[test]
    fn an_order_that_no_order_stopped_at_is_refused() {
        assert!(ViewOrder::resume(1, 3, vec![2, 0]).is_some());
        assert!(ViewOrder::resume(1, 3, vec![3]).is_none(), "a view that there is not");
        assert!(ViewOrder::resume(1, 1, vec![0, 0]).is_none(), "more left than there are");
        assert!(ViewOrder::resume(1, u32::MAX, Vec::new()).is_none(), "a list of 16 GB");
    }

    #[test]
    fn numbers_below_an_end_are_spread_evenly() {
        let mut random = Random::new(5);
        let mut counts = [0u32; 7];
        for _ in 0..70_000 {
            counts[random.below(7) as usize] += 1;
        }
        assert!(counts.iter().all(|&c| (9_500..10_500).contains(&c)), "{counts:?}");
    }
}
