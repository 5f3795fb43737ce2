//! Who is started, in which order, with which scheduling, and who stops when.

use shared_types::ServiceName;

/// The services of a mission on the embedded simulator, in the order of their start. The keeper comes first, since it holds
/// every channel open; who makes the clock and the vehicle comes before who needs them.
pub const START_ORDER: [ServiceName; 9] = [
    ServiceName::Keeper,
    ServiceName::Recorder,
    ServiceName::Simulator,
    ServiceName::World,
    ServiceName::Px4Link,
    ServiceName::Camera,
    ServiceName::Trainer,
    ServiceName::Scorer,
    ServiceName::Planner,
];

/// Groups that stop one after the other. px4-link is the last but the recorder, the simulator and the keeper: while it runs,
/// a vehicle in the air is brought home, and that is recorded.
pub const STOP_GROUPS: [&[ServiceName]; 5] = [
    &[ServiceName::Planner, ServiceName::Scorer, ServiceName::Trainer, ServiceName::Camera, ServiceName::World],
    &[ServiceName::Px4Link],
    &[ServiceName::Recorder],
    &[ServiceName::Simulator],
    &[ServiceName::Keeper],
];

/// What a mission can do without, once it flies.
pub const DISPENSABLE: [ServiceName; 1] = [ServiceName::Recorder];

/// How the kernel's scheduler treats a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// The default.
    Normal,
    /// First in, first out at a real-time priority, where permitted.
    Fifo(u8),
    /// For long computations: rarely preempts others.
    Batch,
}

/// nice value and scheduling policy of a service: the vehicle before the pictures before the training.
#[must_use]
pub fn scheduling(service: ServiceName) -> (i32, Policy) {
    match service {
        ServiceName::Px4Link | ServiceName::Simulator => (0, Policy::Fifo(20)),
        ServiceName::Scorer | ServiceName::World => (5, Policy::Normal),
        ServiceName::Recorder => (10, Policy::Normal),
        ServiceName::Trainer => (15, Policy::Batch),
        _ => (0, Policy::Normal),
    }
}

/// Applies the scheduling of a service to this thread and, since threads inherit it, to all that it will start. Called
/// before a service does anything else. What is not permitted is left as it is: a mission flies without it.
pub fn apply_scheduling(service: ServiceName) {
    use thread_priority::unix::{set_thread_priority_and_policy, thread_native_id};
    use thread_priority::{
        NormalThreadSchedulePolicy, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue,
        ThreadSchedulePolicy,
    };

    let (nice, policy) = scheduling(service);
    let asked = match policy {
        Policy::Normal => None,
        Policy::Fifo(priority) => ThreadPriorityValue::try_from(priority).ok().map(|value| {
            (ThreadPriority::Crossplatform(value), ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo))
        }),
        Policy::Batch => Some((ThreadPriority::Min, ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Batch))),
    };
    if let Some((priority, policy)) = asked
        && let Err(error) = set_thread_priority_and_policy(thread_native_id(), priority, policy)
    {
        tracing::debug!(service = service.name(), ?error, "scheduling policy not permitted");
    }
    // After the policy: setting a normal policy touches the nice value too.
    if nice != 0
        && let Err(error) = rustix::process::setpriority_process(None, nice)
    {
        tracing::debug!(service = service.name(), %error, "nice value not permitted");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_started_service_stops_once_and_px4_link_after_all_but_recorder_simulator_and_keeper() {
        let mut started: Vec<ServiceName> = START_ORDER.to_vec();
        let mut stopped: Vec<ServiceName> = STOP_GROUPS.concat();
        let tail = &stopped[stopped.len() - 4..];
        assert_eq!(tail, [ServiceName::Px4Link, ServiceName::Recorder, ServiceName::Simulator, ServiceName::Keeper]);
        started.sort_by_key(|service| service.code());
        stopped.sort_by_key(|service| service.code());
        assert_eq!(started, stopped);
        assert_eq!(START_ORDER[0], ServiceName::Keeper);
    }

    #[test]
    fn the_trainer_gives_way_to_everyone() {
        let (trainer, policy) = scheduling(ServiceName::Trainer);
        assert_eq!(policy, Policy::Batch);
        for service in START_ORDER {
            assert!(service == ServiceName::Trainer || scheduling(service).0 < trainer);
        }
    }
}
