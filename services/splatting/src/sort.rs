//! Stable radix sort of splats by depth: two passes of 11 bits.
//!
//! Depths are positive, so their bits order like integers. The range of a frame's depths is shifted to 22 bits: for
//! depths within a factor of four that is 2^-21 relative, finer than the depths themselves are known.

#![expect(unsafe_code, reason = "tasks write disjoint parts of shared buffers")]

use crate::workers::{Shared, Workers};

const DIGIT_BITS: u32 = 11;
const DIGITS: usize = 1 << DIGIT_BITS;
/// Below this many items the passes run on one thread: waking another costs more.
const PARALLEL_FROM: usize = 8192;

/// A visible splat: its depth's bits, its index, and the corners of its bounding box in tiles, x | y << 16.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C, align(16))]
pub(crate) struct Item {
    pub key: u32,
    pub gaussian: u32,
    pub first: u32,
    pub last: u32,
}

impl Item {
    /// First x and y, last x and y of the bounding box, in tiles.
    #[inline(always)]
    pub(crate) fn tiles(&self) -> [usize; 4] {
        [self.first & 0xffff, self.first >> 16, self.last & 0xffff, self.last >> 16].map(|t| t as usize)
    }
}

/// Sorts `items`, whose keys lie in `low..=high`, by key; equal keys keep their order. `spare` is as long as `items`.
pub(crate) fn sort_by_key(workers: &Workers, items: &mut [Item], spare: &mut [Item], low: u32, high: u32) {
    let range_bits = u32::BITS - high.saturating_sub(low).leading_zeros();
    let shift = range_bits.saturating_sub(2 * DIGIT_BITS);
    let low_digit = |item: &Item| ((item.key - low) >> shift) as usize % DIGITS;
    let high_digit = |item: &Item| ((item.key - low) >> (shift + DIGIT_BITS)) as usize % DIGITS;
    let parts = if items.len() < PARALLEL_FROM { 1 } else { workers.count() };
    if parts > 1 {
        pass(workers, parts, items, spare, low_digit);
        pass(workers, parts, spare, items, high_digit);
        return;
    }
    // On one thread the second pass counts what the first does, in another order: one look counts for both.
    let mut counts = [[0_u32; DIGITS]; 2];
    for item in items.iter() {
        counts[0][low_digit(item)] += 1;
        counts[1][high_digit(item)] += 1;
    }
    for counts in &mut counts {
        let mut total = 0;
        for count in counts {
            total += std::mem::replace(count, total);
        }
    }
    let [low_counts, high_counts] = &mut counts;
    scatter(items, &Shared::new(spare), low_counts, low_digit);
    scatter(spare, &Shared::new(items), high_counts, high_digit);
}

/// One stable counting pass by a digit.
fn pass(workers: &Workers, parts: usize, from: &[Item], to: &mut [Item], digit: impl Fn(&Item) -> usize + Sync) {
    let length = from.len().div_ceil(parts).max(1);
    let part = |p: usize| &from[(p * length).min(from.len())..((p + 1) * length).min(from.len())];
    let mut counts = vec![0_u32; parts * DIGITS];
    let shared = Shared::new(&mut counts);
    workers.run(parts, |_, p| {
        // SAFETY: one range of counters per part.
        let counts = unsafe { shared.slice_mut(p * DIGITS..(p + 1) * DIGITS) };
        for item in part(p) {
            counts[digit(item)] += 1;
        }
    });
    let mut total = 0;
    for d in 0..DIGITS {
        for p in 0..parts {
            total += std::mem::replace(&mut counts[p * DIGITS + d], total);
        }
    }
    let shared = Shared::new(&mut counts);
    let to = Shared::new(to);
    workers.run(parts, |_, p| {
        // SAFETY: one range of counters per part.
        let next = unsafe { shared.slice_mut(p * DIGITS..(p + 1) * DIGITS) };
        scatter(part(p), &to, next, &digit);
    });
}

/// Writes each item to the next place of its digit. Prefix sums have given every digit of every part its own places.
fn scatter(from: &[Item], to: &Shared<'_, Item>, next: &mut [u32], digit: impl Fn(&Item) -> usize) {
    let Some(next) = next.first_chunk_mut::<DIGITS>() else { return };
    for item in from {
        let place = &mut next[digit(item)];
        // SAFETY: by the prefix sums, nobody else writes this place.
        unsafe { to.write(*place as usize, *item) };
        *place += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sorts_stably_and_the_same_for_any_number_of_workers() {
        let mut state = 1_u32;
        let depths: Vec<f32> = (0..20_000)
            .map(|i| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                if i % 7 == 0 { 2.0 } else { 1.0 + (state >> 8) as f32 / 1e7 }
            })
            .collect();
        let items: Vec<Item> = depths
            .iter()
            .enumerate()
            .map(|(i, d)| Item { key: d.to_bits(), gaussian: i as u32, first: 0, last: 0 })
            .collect();
        let mut expected = items.clone();
        expected.sort_by_key(|item| item.key >> 1);
        let low = items.iter().map(|i| i.key).min().unwrap();
        let high = items.iter().map(|i| i.key).max().unwrap();
        let sorted = |threads: usize| {
            let mut items = items.clone();
            let mut spare = items.clone();
            sort_by_key(&Workers::new(threads).unwrap(), &mut items, &mut spare, low, high);
            items
        };
        let one = sorted(1);
        assert_eq!(one, sorted(2));
        assert_eq!(one, sorted(3));
        for pair in one.windows(2) {
            let (a, b) = (f32::from_bits(pair[0].key), f32::from_bits(pair[1].key));
            assert!(a <= b * (1.0 + 1e-6));
            assert!(a != b || pair[0].gaussian < pair[1].gaussian);
        }
        let mut seen: Vec<u32> = one.iter().map(|i| i.gaussian).collect();
        seen.sort_unstable();
        assert!(seen.iter().enumerate().all(|(i, &g)| i as u32 == g));
    }

    #[test]
    fn nothing_and_one_item_are_sorted() {
        let workers = Workers::sequential();
        sort_by_key(&workers, &mut [], &mut [], 0, 0);
        let mut one = [Item { key: 7, gaussian: 3, first: 1, last: 1 }];
        sort_by_key(&workers, &mut one, &mut [Item::default()], 7, 7);
        assert_eq!(one[0].gaussian, 3);
    }
}
