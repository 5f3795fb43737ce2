//! The last health of every service, kept after its death.

use shared_types::ServiceName;
use shared_types::messages::Health;

/// One entry for each service that was ever heard, in the order of their codes.
#[derive(Debug, Default)]
pub(crate) struct Roster(Vec<Health>);

impl Roster {
    /// Takes a health message; true when it changed the roster. Codes that no service has are a wild writer's.
    pub(crate) fn note(&mut self, health: Health) -> bool {
        if ServiceName::from_code(health.service).is_none_or(|name| name == ServiceName::Command) {
            return false;
        }
        match self.0.binary_search_by_key(&health.service, |entry| entry.service) {
            Ok(at) => {
                // Two lives of one service may overlap for an instant: the younger counts.
                let newer = self.0.get(at).is_some_and(|entry| entry.incarnation <= health.incarnation);
                if newer && let Some(entry) = self.0.get_mut(at) {
                    *entry = health;
                }
                newer
            }
            Err(at) => {
                self.0.insert(at, health);
                true
            }
        }
    }

    /// Whether px4-link or the simulator still runs: with a vehicle in the air they leave after everybody else.
    pub(crate) fn vehicle_is_served(&self) -> bool {
        let serving = [ServiceName::Px4Link.code(), ServiceName::Simulator.code()];
        self.0.iter().any(|health| {
            serving.contains(&health.service) && std::path::Path::new(&format!("/proc/{}", health.pid)).exists()
        })
    }

    pub(crate) fn last(&self) -> &[Health] {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn health(service: u32, incarnation: u64, turns: u64) -> Health {
        Health { service, incarnation, turns, ..Health::default() }
    }

    #[test]
    fn the_younger_life_counts_and_wild_codes_do_not() {
        let mut roster = Roster::default();
        assert!(roster.note(health(6, 10, 1)));
        assert!(roster.note(health(4, 10, 1)));
        assert!(!roster.note(health(6, 9, 5)), "an elder life");
        assert!(!roster.note(health(99, 1, 1)));
        assert!(!roster.note(health(0, 1, 1)));
        assert!(roster.note(health(6, 11, 2)));
        assert_eq!(roster.last().iter().map(|h| (h.service, h.turns)).collect::<Vec<_>>(), [(4, 1), (6, 2)]);
    }
}
