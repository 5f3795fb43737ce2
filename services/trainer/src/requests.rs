//! Which requests wait for which round. A request is known by client and id; asked again it joins, or gets the answer that
//! stands.

use std::collections::VecDeque;

use shared_types::bus::ReplyAddress;

use crate::round::{FinishedRound, RoundSpec};

/// A round that is waited for.
#[derive(Debug, Clone)]
pub struct Wanted {
    /// What is asked.
    pub spec: RoundSpec,
    /// Who waits for it.
    pub addresses: Vec<ReplyAddress>,
}

/// What becomes of a request at once.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// It waits, or joined those that do.
    Waits,
    /// The round is over already.
    Done(FinishedRound),
    /// It cannot be.
    Refused(String),
}

/// Rounds that are waited for, and rounds that are over.
#[derive(Debug, Default)]
pub struct Requests {
    /// The first is under work where the service trains.
    pub wanted: VecDeque<Wanted>,
    /// Rounds that are over, in their order.
    pub finished: Vec<FinishedRound>,
}

impl Requests {
    /// Takes a request.
    pub fn take(&mut self, spec: RoundSpec, address: ReplyAddress) -> Verdict {
        if let Some(wanted) = self.wanted.iter_mut().find(|wanted| wanted.spec.round == spec.round) {
            if wanted.spec != spec {
                return Verdict::Refused(format!("round {} is asked for with another content", spec.round));
            }
            if !wanted.addresses.contains(&address) {
                wanted.addresses.push(address);
            }
            return Verdict::Waits;
        }
        if let Some(done) = self.finished.iter().find(|done| done.spec.round == spec.round) {
            return if done.spec == spec {
                Verdict::Done(done.clone())
            } else {
                Verdict::Refused(format!("round {} was run with another content", spec.round))
            };
        }
        let last = self.finished.last().map(|done| done.spec.round);
        if last.is_some_and(|last| spec.round < last) {
            return Verdict::Refused(format!(
                "round {} comes before round {}, which is over",
                spec.round,
                last.unwrap_or(0)
            ));
        }
        self.wanted.push_back(Wanted { spec, addresses: vec![address] });
        Verdict::Waits
    }
}

#[cfg(test)]
mod tests {
    use shared_types::messages::RoundRequest;

    use super::*;
    use crate::round::Progress;

    fn address(request_id: u64) -> ReplyAddress {
        ReplyAddress { client: 8, client_incarnation: 0, request_id, sent_ns: 0 }
    }

    fn spec(round: u32) -> RoundSpec {
        let request =
            RoundRequest { round, max_iterations: 9, box_size_m: 2.0, radius_m: 2.5, ..RoundRequest::default() };
        RoundSpec::from_request(&request, &[1, 2]).unwrap()
    }

    #[test]
    fn the_same_request_joins_and_another_content_is_refused() {
        let mut requests = Requests::default();
        assert_eq!(requests.take(spec(0), address(5)), Verdict::Waits);
        assert_eq!(requests.take(spec(0), address(5)), Verdict::Waits);
        assert_eq!(requests.take(spec(0), address(6)), Verdict::Waits, "a restarted client with a new id");
        assert_eq!(requests.wanted.len(), 1);
        assert_eq!(requests.wanted[0].addresses.len(), 2);
        let other = RoundSpec { seed: 99, ..spec(0) };
        assert!(
            matches!(requests.take(other, address(7)), Verdict::Refused(reason) if reason.contains("another content"))
        );
    }

    #[test]
    fn a_round_that_is_over_is_answered_from_memory() {
        let mut requests = Requests::default();
        let done = FinishedRound { spec: spec(3), progress: Progress::default(), generation: 7 };
        requests.finished.push(done.clone());
        assert_eq!(requests.take(spec(3), address(1)), Verdict::Done(done));
        assert!(matches!(requests.take(RoundSpec { window: 10, ..spec(3) }, address(1)), Verdict::Refused(_)));
        assert!(matches!(requests.take(spec(1), address(2)), Verdict::Refused(_)), "rounds go forward");
        assert_eq!(requests.take(spec(4), address(3)), Verdict::Waits);
    }
}
