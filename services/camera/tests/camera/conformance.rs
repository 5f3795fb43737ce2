//! The simulator's source keeps the contract of sources.

use crate::common::{Domain, Flight, World, tick};
use camera::conformance::{Bench, check_all};
use camera::source::RgbdSource;
use camera::sources::simulator::SimulatorSource;
use glam::DVec3;
use shared_types::config::CameraConfig;
use shared_types::frames::Intrinsics;
use shared_types::messages::RenderPurpose;
use shared_types::service::ServiceName;

struct SimulatorBench {
    source: SimulatorSource,
    world: World,
    config: CameraConfig,
    _domain: Domain,
}

impl Bench for SimulatorBench {
    fn source(&mut self) -> &mut dyn RgbdSource {
        &mut self.source
    }

    fn work(&mut self) {
        self.world.work();
        // The bus asks again for a reply that was lost, but not before half a second of wall time.
        std::thread::sleep(std::time::Duration::from_millis(1));
    }

    fn known_ns(&self) -> u64 {
        tick(50)
    }

    fn unknown_ns(&self) -> u64 {
        tick(2)
    }

    fn stamp_tolerance_ns(&self) -> u64 {
        0
    }

    fn intrinsics(&self, purpose: RenderPurpose) -> Intrinsics {
        match purpose {
            RenderPurpose::Capture => self.config.intrinsics(),
            RenderPurpose::Stream => self.config.stream_intrinsics(),
            RenderPurpose::Depth => self.config.depth_intrinsics(),
        }
    }
}

#[test]
fn the_simulators_source_conforms() {
    let config = CameraConfig { width_px: 64, height_px: 48, ..CameraConfig::default() };
    let domain = Domain::new(config.clone());
    let flight = Flight {
        start_m: DVec3::new(-1.5, 0.0, 1.5),
        velocity_mps: DVec3::ZERO,
        yaw_rad: 0.0,
        yaw_rate_radps: 0.0,
        pitch_rad: -0.6,
        lever_body_m: [0.0; 3],
        lever_gimbal_m: [0.0; 3],
    };
    let mut world = World::new(&domain, flight);
    world.known_ns = tick(10)..=tick(100);
    let source = SimulatorSource::new(domain.join(ServiceName::Camera).client().expect("client"));
    let mut bench = SimulatorBench { source, world, config, _domain: domain };
    for (name, outcome) in check_all(&mut bench) {
        assert_eq!(outcome, Ok(()), "{name}");
    }
}
