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
                    let again = u32::from(entry.incarnation < health.incarnation);
                    *entry = Health { restarts: entry.restarts.saturating_add(again), ..health };
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
        self.0.iter().any(|health| serving.contains(&health.service) && runs(health.pid))
    }

    pub(crate) fn last(&self) -> &[Health] {
        &self.0
    }
}

/// Whether a process runs. One that nobody has reaped (its parent died too) does not.
fn runs(pid: u32) -> bool {
    // pid (name) state ...: the name may hold anything, so the last ')' counts.
    std::fs::read_to_string(format!("/proc/{pid}/stat"))
        .is_ok_and(|stat| stat.rsplit_once(") ").is_some_and(|(_, rest)| !rest.starts_with(['Z', 'X'])))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn health(service: u32, incarnation: u64, turns: u64) -> Health {
        Health { service, incarnation, turns, ..Health::default() }
    }

    #[test]
    fn a_vehicle_is_served_by_living_processes_only() {
        let mut child = std::process::Command::new("true").spawn().expect("true runs");
        let mut roster = Roster::default();
        roster.note(Health { pid: child.id(), ..health(ServiceName::Px4Link.code(), 1, 1) });
        let began = std::time::Instant::now();
        while roster.vehicle_is_served() {
            assert!(began.elapsed() < std::time::Duration::from_secs(10), "a zombie counts as alive");
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        child.wait().expect("reaped only now");
        roster.note(Health { pid: std::process::id(), ..health(ServiceName::Planner.code(), 1, 1) });
        assert!(!roster.vehicle_is_served(), "the planner does not serve the vehicle");
        roster.note(Health { pid: std::process::id(), ..health(ServiceName::Simulator.code(), 1, 1) });
        assert!(roster.vehicle_is_served());
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
        assert_eq!(roster.last().iter().map(|h| h.restarts).collect::<Vec<_>>(), [0, 1]);
    }
}
