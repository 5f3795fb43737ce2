//! Models: files of the field's tools, and checkpoints. What is read is written again, and what was written is read.

use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use glam::{Quat, Vec3};
use std::hint::black_box;
use std::io::{Read as _, Write as _};

use splatting::formats::{Format, read, write};
use splatting::{DensifierState, Engine, Gaussian, Gaussians, Optimiser, Training};

use crate::seal;

fn gaussians(count: u64, degree: u8) -> Gaussians {
    let mut model = Gaussians::new();
    for id in 0..count {
        let k = id as f32;
        model.push(&Gaussian {
            mean: Vec3::new(0.1 * k, 0.2, -0.3),
            log_scales: Vec3::new(-3.0, -2.5, -4.0 - 0.1 * k),
            rotation: Quat::from_rotation_z(0.2 * k),
            opacity_logit: 0.5 - 0.2 * k,
            sh: [0.1, -0.2, 0.3],
            id,
            birth_round: 1,
        });
    }
    model.set_sh_degree(degree);
    model
}

fn written(format: Format, count: u64, degree: u8) -> Vec<u8> {
    let mut bytes = Vec::new();
    match write(format, &gaussians(count, degree), false, &mut bytes) {
        Ok(()) => bytes,
        Err(error) => panic!("{error}"),
    }
}

fn file(format: Format, data: &[u8]) {
    let Ok(model) = read(format, data) else { return };
    for format in Format::ALL {
        let mut bytes = Vec::new();
        // A format may not hold what another does, and says so.
        if write(format, &model, true, &mut bytes).is_ok() {
            let again = read(format, &bytes).unwrap_or_else(|error| panic!("{format:?} is not read again: {error}"));
            assert_eq!(again.len(), model.len(), "{format:?}");
        }
    }
}

/// PLY.
pub fn ply(data: &[u8]) {
    file(Format::Ply, data);
}

/// `.splat`.
pub fn splat(data: &[u8]) {
    file(Format::Splat, data);
}

/// SPZ: the bytes behind the gzip, or where the first is odd the file as it is.
pub fn spz(data: &[u8]) {
    match data.split_first() {
        Some((first, rest)) if first % 2 == 0 => file(Format::Spz, &zipped(rest)),
        Some((_, rest)) => file(Format::Spz, rest),
        None => {}
    }
}

/// Binary glTF.
pub fn glb(data: &[u8]) {
    file(Format::Glb, data);
}

fn zipped(data: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(data).and_then(|()| encoder.finish()).unwrap_or_default()
}

/// Models of several degrees.
pub fn ply_seeds() -> Vec<Vec<u8>> {
    vec![written(Format::Ply, 3, 0), written(Format::Ply, 2, 3), written(Format::Ply, 0, 0)]
}

/// Models.
pub fn splat_seeds() -> Vec<Vec<u8>> {
    vec![written(Format::Splat, 1, 0), written(Format::Splat, 5, 0)]
}

/// Models of several degrees, unpacked and packed.
pub fn spz_seeds() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    for degree in 0..=3 {
        let packed = written(Format::Spz, 3, degree);
        let mut unpacked = vec![0];
        if GzDecoder::new(&packed[..]).read_to_end(&mut unpacked).is_ok() {
            seeds.push(unpacked);
        }
        seeds.push([&[1][..], &packed].concat());
    }
    seeds
}

/// Models of several degrees.
pub fn glb_seeds() -> Vec<Vec<u8>> {
    vec![written(Format::Glb, 2, 0), written(Format::Glb, 2, 2)]
}

/// The model and its optimiser in every checkpoint.
pub fn checkpoint(data: &[u8]) {
    use splatting::checkpoint::{decode, encode};
    let Ok((model, optimiser)) = decode(&seal::model(data)) else { return };
    let bytes = encode(&model, &optimiser);
    let (again, _) = decode(&bytes).unwrap_or_else(|error| panic!("not read again: {error}"));
    assert_eq!(again.len(), model.len());
}

/// With and without state.
pub fn checkpoint_seeds() -> Vec<Vec<u8>> {
    [(3, 0), (2, 2), (0, 0)]
        .map(|(count, degree)| splatting::checkpoint::encode(&gaussians(count, degree), &state(count, degree)))
        .to_vec()
}

fn state(count: u64, degree: u8) -> Optimiser {
    let mut optimiser = Optimiser::new();
    optimiser.fit(&gaussians(count, degree));
    optimiser
}

fn engine() -> Engine {
    Engine::new(1).unwrap_or_else(|error| panic!("{error}"))
}

fn session() -> trainer::session::Session {
    let config = shared_types::config::Config::default();
    trainer::session::Session::new(config.trainer, config.model, engine())
}

/// The trainer's checkpoint, taken up by a session.
pub fn trainer(data: &[u8]) {
    let Ok(checkpoint) = trainer::checkpoint::from_bytes(&seal::checkpoint(data)) else { return };
    let mut session = session();
    checkpoint.restore_into(&mut session);
    black_box((session.progress(), session.snapshot()));
    let bytes = trainer::checkpoint::to_bytes(&session);
    trainer::checkpoint::from_bytes(&bytes).unwrap_or_else(|error| panic!("not read again: {error}"));
    // Without its keyframes a round in work cannot go on, and says so.
    session.resume(&mut NoKeyframes).unwrap_or(());
    session.advance(2, || ()).unwrap_or_else(|error| panic!("{error}"));
    session.finish().unwrap_or_else(|error| panic!("{error}"));
}

struct NoKeyframes;

impl trainer::keyframes::KeyframeSource for NoKeyframes {
    fn read(&mut self, _id: u64) -> Result<Option<shared_types::folder::Keyframe>, shared_types::folder::FolderError> {
        Ok(None)
    }
}

/// Before the first round, and bytes of one in work by hand: the writer of a session needs keyframes for it.
pub fn trainer_seeds() -> Vec<Vec<u8>> {
    use splatting::bytes::Writer;
    let mut w = Writer::default();
    w.u64(u64::from_le_bytes(*b"VNTGCKPT"));
    w.u32(1);
    w.u64(120);
    w.u64(9);
    w.list([1u64, 2].iter(), |w, &id| w.u64(id));
    let spec = |w: &mut Writer| {
        [1u32, 750, 1, 0].iter().for_each(|&value| w.u32(value));
        [0.0, 0.0, 0.5, 1.5, 2.5, 0.0].iter().for_each(|&value| w.f64(value));
        w.u64(7);
        w.list([1u64, 2].iter(), |w, &id| w.u64(id));
    };
    w.list([()].iter(), |w, ()| {
        spec(w);
        w.u32(100);
        w.u64(100);
        w.u64(3);
        w.f64(0.1);
        w.f64(28.0);
        w.u64(201);
    });
    w.list([()].iter(), |w, ()| {
        spec(w);
        w.u32(20);
        w.u64(77);
        w.u32(2);
        w.list([1u32].iter(), |w, &view| w.u32(view));
        w.u32(100);
        w.list([0.2, 0.1].iter(), |w, &loss| w.f64(loss));
        w.list([25.0].iter(), |w, &db| w.f64(db));
    });
    w.list([()].iter(), |w, ()| {
        w.f32(0.02);
        w.list([[1i32, 2, 3]].iter(), |w, key| {
            key.iter().for_each(|&k| w.i32(k));
            w.f32(0.01);
        });
    });
    w.blob(&splatting::checkpoint::encode(&gaussians(3, 0), &state(3, 0)));
    w.u64(0);
    vec![trainer::checkpoint::to_bytes(&session()), w.into_bytes()]
}

/// The checkpoint of an offline run.
pub fn reconstruct(data: &[u8]) {
    let bytes = seal::checkpoint(data);
    // Of whatever run: its number is not what is tried here.
    let run = bytes.get(12..20).and_then(|b| b.try_into().ok()).map_or(0, u64::from_le_bytes);
    let Ok(state) = reconstruct::checkpoint::from_bytes(&bytes, run) else { return };
    let mut order = state.progression.order.clone();
    let views = order.parts().1;
    assert!((0..4).all(|_| order.next_view().is_none_or(|view| view < views)), "a view that there is not");
    let mut training = Training::new(engine());
    training.restore_observed(state.model, state.optimiser, state.statistics);
    let again = reconstruct::checkpoint::to_bytes(&training, &state.progression, run);
    reconstruct::checkpoint::from_bytes(&again, run).unwrap_or_else(|error| panic!("not read again: {error}"));
}

/// A run under way.
pub fn reconstruct_seeds() -> Vec<Vec<u8>> {
    let mut training = Training::new(engine());
    training.restore(gaussians(3, 1), state(3, 1));
    let mut order = splatting::order::ViewOrder::new(5, 3);
    order.next_view();
    let progression = reconstruct::checkpoint::Progression {
        iteration: 70,
        order,
        recent_psnr_db: [20.0, 21.0].into(),
        rows: vec![reconstruct::report::Row {
            iteration: 50,
            cpu_s: 1.0,
            wall_s: 0.6,
            gaussians: 3,
            train_psnr_db: Some(20.0),
            held_out_psnr_db: None,
            held_out_ssim: None,
            held_out_frame_psnr_db: None,
        }],
        cpu_s: 1.0,
        wall_s: 0.6,
        densifier: DensifierState { seed: 1, random: 2, next_id: 3 },
        backends: vec!["cpu".to_owned()],
    };
    vec![reconstruct::checkpoint::to_bytes(&training, &progression, 42)]
}
