//! The snapshots that the scorer holds: the last two final ones, copied out of shared memory.
//!
//! Two, because the planner may score on round k-1 while round k ends. A scorer that was restarted may find only a live
//! snapshot on the channel; it is held until a final one comes, so that there is something to score on.

use crate::job::Held;

/// Final snapshots held.
const FINALS: usize = 2;

/// What asking for a generation comes to.
#[derive(Debug, Clone)]
pub enum Lookup {
    /// Here it is.
    Found(Held),
    /// It has not been seen yet.
    NotYet,
    /// It is not to be had any more.
    Gone,
}

/// The snapshots held, oldest first.
#[derive(Debug, Clone, Default)]
pub struct Holdings {
    held: Vec<Held>,
}

impl Holdings {
    /// Whether a snapshot is worth copying.
    #[must_use]
    pub fn wants(&self, generation: u64, is_final: bool) -> bool {
        let known = self.held.iter().any(|held| held.generation == generation);
        let newer = self.held.iter().filter(|held| held.is_final).all(|held| held.generation < generation);
        !known && if is_final { newer } else { self.held.is_empty() }
    }

    /// Takes a snapshot.
    pub fn take(&mut self, held: Held) {
        if !self.wants(held.generation, held.is_final) {
            return;
        }
        if held.is_final {
            self.held.retain(|other| other.is_final);
        }
        self.held.push(held);
        if self.held.len() > FINALS {
            self.held.remove(0);
        }
    }

    /// Generation of the newest snapshot held; 0 without any.
    #[must_use]
    pub fn newest_generation(&self) -> u64 {
        self.held.last().map_or(0, |held| held.generation)
    }

    /// Looks for a generation. Generations grow, so an older one that is not held will not come any more.
    #[must_use]
    pub fn look(&self, generation: u64) -> Lookup {
        match self.held.iter().find(|held| held.generation == generation) {
            Some(held) => Lookup::Found(held.clone()),
            None if generation < self.newest_generation() => Lookup::Gone,
            None => Lookup::NotYet,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn held(generation: u64, is_final: bool) -> Held {
        Held::new(generation, is_final, &[])
    }

    #[test]
    fn the_last_two_final_ones_are_held() {
        let mut holdings = Holdings::default();
        assert!(matches!(holdings.look(5), Lookup::NotYet));
        for generation in [5, 9, 13] {
            holdings.take(held(generation, true));
            assert!(!holdings.wants(generation, true), "sent again after the trainer's restart");
        }
        assert!(matches!(holdings.look(5), Lookup::Gone));
        assert!(matches!(holdings.look(9), Lookup::Found(found) if found.generation == 9));
        assert!(matches!(holdings.look(13), Lookup::Found(_)));
        assert!(matches!(holdings.look(14), Lookup::NotYet));
        assert!(!holdings.wants(16, false), "live ones are not copied while final ones are held");
        assert_eq!(holdings.newest_generation(), 13);
    }

    #[test]
    fn after_a_restart_a_live_one_serves_until_a_final_one_comes() {
        let mut holdings = Holdings::default();
        holdings.take(held(20, false));
        holdings.take(held(22, false));
        assert!(matches!(holdings.look(13), Lookup::Gone), "asks for the one before the restart");
        assert_eq!(holdings.newest_generation(), 20, "the one that was announced stays");
        assert!(matches!(holdings.look(20), Lookup::Found(_)));
        holdings.take(held(25, true));
        assert!(matches!(holdings.look(20), Lookup::Gone));
        assert!(matches!(holdings.look(25), Lookup::Found(_)));
    }
}
