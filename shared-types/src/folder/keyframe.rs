//! Keyframes on disk: `rgb.png` (8-bit RGB), `depth.png` (16-bit grey, big-endian as PNG has it, in units of
//! `depth_unit_m`, 0 = no measurement) and `frame.json` (pose, camera, why and how still), complete or absent.

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::files::{io_error, replace_dir_atomic, write_dir_atomic};
use super::png_file::{Kind, damaged, decode, encode};
use super::{FolderError, MissionFolder};
use crate::frames::{Intrinsics, Pose};
use crate::messages::{FrameHeader, KeyframeReason};

const MAX_SIDE_PX: u32 = 8192;

/// `frame.json`: everything about a stored image but its pixels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Keyframe id.
    pub id: u64,
    /// Mission time of the image, nanoseconds.
    pub stamp_ns: u64,
    /// Why it was taken.
    pub reason: KeyframeReason,
    /// The candidate's index on the Fibonacci sphere, for a selected view.
    pub candidate: Option<u32>,
    /// The target whose end the view is; 0: none.
    pub target_id: u64,
    /// What the camera was to look at, metres in the world.
    pub look_at_m: [f64; 3],
    /// Measured position of the camera (optical frame) in the world at the stamp, metres.
    pub world_from_camera_position_m: [f64; 3],
    /// Measured rotation of the camera in the world at the stamp.
    pub world_from_camera_xyzw: [f64; 4],
    /// The pinhole camera; the centre of pixel (0, 0) is (0.5, 0.5).
    pub intrinsics: Intrinsics,
    /// Metres per unit of `depth.png`.
    pub depth_unit_m: f64,
    /// How still the camera was.
    pub gate: Gate,
    /// How the image was exposed.
    pub exposure: Exposure,
}

/// How still the camera was at the image's stamp.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Gate {
    /// True when the capture gate was never met and the stillest image was taken.
    pub missed: bool,
    /// Speed of the camera, m/s.
    pub speed_mps: f64,
    /// Angular rate of the camera, rad/s.
    pub rate_radps: f64,
    /// One standard deviation of the stamp, seconds.
    pub time_uncertainty_s: f64,
    /// Motion blur at what the camera looks at, pixels.
    pub blur_px: f64,
}

/// How an image was exposed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Exposure {
    /// Whether exposure and white balance were locked.
    pub locked: bool,
    /// Exposure time, seconds.
    pub time_s: f64,
}

/// A keyframe, or a view of the prior.
#[derive(Debug, Clone, PartialEq)]
pub struct Keyframe {
    /// What the images are.
    pub frame: Frame,
    /// `width * height * 3` bytes of sRGB, row by row.
    pub rgb: Vec<u8>,
    /// `width * height` depths (centre z in units of `frame.depth_unit_m`), row by row; 0 = no measurement.
    pub depth_units: Vec<u16>,
}

impl Frame {
    /// Pose of the camera in the world.
    #[must_use]
    pub fn world_from_camera(&self) -> Pose {
        Pose {
            position_m: DVec3::from_array(self.world_from_camera_position_m),
            rotation: DQuat::from_array(self.world_from_camera_xyzw).normalize(),
        }
    }

    /// Header of this frame on `camera/keyframe`.
    #[must_use]
    pub fn header(&self) -> FrameHeader {
        let mut header = FrameHeader {
            id: self.id,
            world_from_camera_position_m: self.world_from_camera_position_m,
            world_from_camera_xyzw: self.world_from_camera_xyzw,
            depth_unit_m: self.depth_unit_m,
            speed_mps: self.gate.speed_mps,
            rate_radps: self.gate.rate_radps,
            time_uncertainty_s: self.gate.time_uncertainty_s,
            has_color: 1,
            reason: self.reason.code(),
            gate_missed: u32::from(self.gate.missed),
            candidate: self.candidate.unwrap_or(u32::MAX),
            ..FrameHeader::default()
        };
        header.set_intrinsics(&self.intrinsics);
        header
    }

    fn check(&self, path: &Path) -> Result<(), FolderError> {
        let no = |field: &str, found: String, expected: &str| Err(damaged(path, field, &found, expected));
        let camera = &self.intrinsics;
        if !(1..=MAX_SIDE_PX).contains(&camera.width) || !(1..=MAX_SIDE_PX).contains(&camera.height) {
            return no("intrinsics", format!("{} x {}", camera.width, camera.height), "1 to 8192 pixels a side");
        }
        if ![camera.fx, camera.fy].iter().all(|f| f.is_finite() && *f > 0.0)
            || ![camera.cx, camera.cy].iter().all(|c| c.is_finite())
        {
            return no("intrinsics", format!("{camera:?}"), "finite, positive focal lengths");
        }
        if !(self.depth_unit_m.is_finite() && self.depth_unit_m > 0.0) {
            return no("depth_unit_m", self.depth_unit_m.to_string(), "above 0");
        }
        if !self.world_from_camera_position_m.iter().chain(&self.look_at_m).all(|v| v.is_finite()) {
            return no(
                "world_from_camera_position_m",
                format!("{:?}", self.world_from_camera_position_m),
                "finite numbers",
            );
        }
        let length = DQuat::from_array(self.world_from_camera_xyzw).length();
        if !(0.999..=1.001).contains(&length) {
            return no("world_from_camera_xyzw", format!("of length {length}"), "a quaternion of length 1");
        }
        Ok(())
    }
}

impl Keyframe {
    /// All depths in metres, row by row; 0 = no measurement.
    #[must_use]
    pub fn depth_m(&self) -> Vec<f32> {
        #[expect(clippy::cast_possible_truncation, reason = "depth is kept as f32 metres inside programs")]
        let unit = self.frame.depth_unit_m as f32;
        self.depth_units.iter().map(|&units| f32::from(units) * unit).collect()
    }

    /// The items of `camera/keyframe`: colour, then little-endian depth. Does nothing where `items` has another length
    /// than [`FrameHeader::items_len`] says.
    pub fn fill_items(&self, items: &mut [u8]) {
        if items.len() != self.rgb.len() + self.depth_units.len() * 2 {
            return;
        }
        let (rgb, depth) = items.split_at_mut(self.rgb.len());
        rgb.copy_from_slice(&self.rgb);
        for (to, units) in depth.chunks_exact_mut(2).zip(&self.depth_units) {
            to.copy_from_slice(&units.to_le_bytes());
        }
    }
}

impl MissionFolder {
    /// Writes a keyframe or a view of the prior, whole, and brings it to the disk. A keyframe is never overwritten; a
    /// view of the prior takes the place of an earlier one, since the survey may have to look again.
    ///
    /// # Errors
    /// [`FolderError::Exists`] for a keyframe that is there; [`FolderError::Full`], [`FolderError::Io`];
    /// [`FolderError::Damaged`] for a keyframe whose parts do not fit each other, or a frame of the stream.
    pub fn write_keyframe(&self, keyframe: &Keyframe) -> Result<PathBuf, FolderError> {
        let frame = &keyframe.frame;
        let Some(path) = self.view_path(frame.reason, frame.id) else {
            return Err(damaged(self.root(), "reason", frame.reason.name(), "a keyframe's or a prior view's"));
        };
        let json_path = path.join("frame.json");
        frame.check(&json_path)?;
        let (width, height) = (frame.intrinsics.width, frame.intrinsics.height);
        let pixels = width as usize * height as usize;
        if keyframe.rgb.len() != pixels * 3 || keyframe.depth_units.len() != pixels {
            let found = format!("{} of colour, {} of depth", keyframe.rgb.len(), keyframe.depth_units.len());
            return Err(damaged(&path, "pixels", &found, &format!("{width} x {height}")));
        }
        let rgb = encode(&path.join("rgb.png"), Kind::Rgb8, width, height, &keyframe.rgb)?;
        let depth_bytes: Vec<u8> = keyframe.depth_units.iter().flat_map(|units| units.to_be_bytes()).collect();
        let depth = encode(&path.join("depth.png"), Kind::Grey16, width, height, &depth_bytes)?;
        // No newline at the end: a file that lacks its last byte is then always seen to be cut.
        let json = serde_json::to_vec_pretty(frame)
            .map_err(|error| damaged(&json_path, "frame", &error.to_string(), "numbers that JSON can hold"))?;
        let files: [(&str, &[u8]); 3] = [("rgb.png", &rgb), ("depth.png", &depth), ("frame.json", &json)];
        if frame.reason.is_survey() {
            replace_dir_atomic(&path, &files)?;
        } else {
            write_dir_atomic(&path, &files)?;
        }
        Ok(path)
    }

    /// Reads a keyframe; `None` when there is none of this id.
    ///
    /// # Errors
    /// [`FolderError::Damaged`] or [`FolderError::Io`], naming the file and what is wrong with it.
    pub fn read_keyframe(&self, id: u64) -> Result<Option<Keyframe>, FolderError> {
        self.read_view(KeyframeReason::Selected, id)
    }

    /// Reads the view of the prior taken for a reason; `None` when there is none, or the reason is not a prior's.
    ///
    /// # Errors
    /// As [`Self::read_keyframe`].
    pub fn read_prior(&self, reason: KeyframeReason) -> Result<Option<Keyframe>, FolderError> {
        if reason.is_survey() { self.read_view(reason, 0) } else { Ok(None) }
    }

    /// Reads the `frame.json` of the view that a reason and an id name, without its images; `None` when there is none.
    ///
    /// # Errors
    /// As [`Self::read_keyframe`].
    pub fn read_frame(&self, reason: KeyframeReason, id: u64) -> Result<Option<Frame>, FolderError> {
        match self.view_path(reason, id) {
            Some(path) if path.is_dir() => read_frame_of(&path).map(Some),
            _ => Ok(None),
        }
    }

    /// Reads the view that a reason and an id name; `None` when there is none.
    ///
    /// # Errors
    /// As [`Self::read_keyframe`].
    pub fn read_view(&self, reason: KeyframeReason, id: u64) -> Result<Option<Keyframe>, FolderError> {
        let Some(path) = self.view_path(reason, id).filter(|path| path.is_dir()) else { return Ok(None) };
        let keyframe = read_view_folder(&path)?;
        if !reason.is_survey() && keyframe.frame.id != id {
            let json_path = path.join("frame.json");
            return Err(damaged(&json_path, "id", &keyframe.frame.id.to_string(), &format!("{id} as its folder says")));
        }
        Ok(Some(keyframe))
    }

    /// Ids of all keyframes, ascending. Prior views are not keyframes.
    ///
    /// # Errors
    /// [`FolderError::Io`] when the folder cannot be read.
    pub fn list_keyframes(&self) -> Result<Vec<u64>, FolderError> {
        let path = self.keyframes_path();
        let entries = match fs::read_dir(&path) {
            Ok(entries) => entries,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(source) => return Err(io_error("read", &path, source)),
        };
        let mut ids = Vec::new();
        for entry in entries {
            let entry = entry.map_err(|source| io_error("read", &path, source))?;
            let name = entry.file_name();
            let id = name.to_str().filter(|name| name.len() >= 6).and_then(|name| name.parse().ok());
            if let Some(id) = id.filter(|id| *name == *format!("{id:06}")) {
                ids.push(id);
            }
        }
        ids.sort_unstable();
        Ok(ids)
    }
}

/// Reads the three files of a view from its folder.
///
/// # Errors
/// [`FolderError::Damaged`] or [`FolderError::Io`], naming the file and what is wrong with it.
pub fn read_view_folder(path: &Path) -> Result<Keyframe, FolderError> {
    let frame = read_frame_of(path)?;
    let (width, height) = (frame.intrinsics.width, frame.intrinsics.height);
    let rgb_path = path.join("rgb.png");
    let rgb = decode(&rgb_path, Kind::Rgb8, width, height, &read(&rgb_path)?)?;
    let depth_path = path.join("depth.png");
    let depth = decode(&depth_path, Kind::Grey16, width, height, &read(&depth_path)?)?;
    let depth_units = depth.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect();
    Ok(Keyframe { frame, rgb, depth_units })
}

fn read_frame_of(path: &Path) -> Result<Frame, FolderError> {
    let json_path = path.join("frame.json");
    let frame: Frame = serde_json::from_slice(&read(&json_path)?)
        .map_err(|error| damaged(&json_path, "content", &error.to_string(), "the JSON of a frame"))?;
    frame.check(&json_path)?;
    Ok(frame)
}

fn read(path: &Path) -> Result<Vec<u8>, FolderError> {
    fs::read(path).map_err(|source| io_error("read", path, source))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn keyframe(id: u64, width: u32, height: u32, seed: u32) -> Keyframe {
        let pixels = width * height;
        let mix = |i: u32| (i ^ seed).wrapping_mul(2_654_435_761).rotate_left(i % 31);
        let camera =
            crate::frames::look_at(DVec3::new(1.0, f64::from(seed % 97) - 48.0, 2.0), DVec3::new(0.1, 0.2, 0.3));
        Keyframe {
            frame: Frame {
                id,
                stamp_ns: 12_340_000_000 + u64::from(seed),
                reason: KeyframeReason::Selected,
                candidate: seed.is_multiple_of(2).then_some(seed % 100),
                target_id: 7,
                look_at_m: [0.1, 0.2, 0.3],
                world_from_camera_position_m: camera.position_m.to_array(),
                world_from_camera_xyzw: camera.rotation.to_array(),
                intrinsics: Intrinsics::from_hfov(width, height, 1.204),
                depth_unit_m: 0.000_2,
                gate: Gate { speed_mps: 0.01, time_uncertainty_s: 0.001, ..Gate::default() },
                exposure: Exposure { locked: true, time_s: 0.004 },
            },
            rgb: (0..pixels * 3).map(|i| mix(i).to_le_bytes()[1]).collect(),
            depth_units: (0..pixels)
                .map(|i| u16::from_le_bytes([mix(i).to_le_bytes()[0], mix(i).to_le_bytes()[2]]))
                .collect(),
        }
    }

    fn folder() -> (tempfile::TempDir, MissionFolder) {
        let dir = tempfile::tempdir().expect("tempdir");
        let folder = MissionFolder::create(dir.path().join("m")).expect("create");
        (dir, folder)
    }

    fn assert_close(a: &[f64], b: &[f64]) {
        for (a, b) in a.iter().zip(b) {
            assert!((a - b).abs() <= 1e-12 * a.abs().max(1.0), "{a} {b}");
        }
    }

    #[test]
    fn views_go_where_their_reason_says() {
        let (_dir, folder) = folder();
        let mut view = keyframe(17, 8, 6, 1);
        assert_eq!(folder.write_keyframe(&view).expect("write"), folder.root().join("keyframes/000017"));
        view.frame.reason = KeyframeReason::PriorOverhead;
        view.frame.id = 1;
        assert_eq!(folder.write_keyframe(&view).expect("write"), folder.root().join("prior/overhead"));
        view.frame.id = 2;
        folder.write_keyframe(&view).expect("the survey looks again");
        let again = folder.read_prior(KeyframeReason::PriorOverhead).expect("read").expect("there");
        assert_eq!(again.frame.id, 2);
        assert_eq!(folder.read_prior(KeyframeReason::PriorSide).expect("read"), None);
        view.frame.reason = KeyframeReason::Stream;
        folder.write_keyframe(&view).expect_err("a frame of the stream has no place");
        assert_eq!(folder.list_keyframes().expect("list"), [17]);
    }

    #[test]
    fn a_keyframe_exists_once() {
        let (_dir, folder) = folder();
        folder.write_keyframe(&keyframe(3, 8, 6, 1)).expect("first");
        let error = folder.write_keyframe(&keyframe(3, 8, 6, 2)).expect_err("second");
        assert!(matches!(error, FolderError::Exists { .. }), "{error}");
        assert_eq!(folder.read_keyframe(3).expect("read").expect("there").rgb, keyframe(3, 8, 6, 1).rgb);
        assert_eq!(folder.read_keyframe(4).expect("read"), None);
    }

    #[test]
    fn half_made_folders_and_strangers_are_not_listed() {
        let (_dir, folder) = folder();
        for id in [12, 3, 1_000_000] {
            folder.write_keyframe(&keyframe(id, 2, 2, 1)).expect("write");
        }
        for name in [".tmp-1-2-3-000009", "notes", "7", "+00008", "0000012"] {
            fs::create_dir(folder.keyframes_path().join(name)).expect("dir");
        }
        assert_eq!(folder.list_keyframes().expect("list"), [3, 12, 1_000_000]);
    }

    #[test]
    fn depth_is_big_endian_grey_for_other_tools() {
        let (_dir, folder) = folder();
        let mut view = keyframe(1, 2, 1, 1);
        view.depth_units = vec![0x0102, 0xfffe];
        let path = folder.write_keyframe(&view).expect("write");
        let file = fs::read(path.join("depth.png")).expect("read");
        let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().expect("png");
        let mut pixels = [0; 4];
        reader.next_frame(&mut pixels).expect("pixels");
        assert_eq!(pixels, [1, 2, 0xff, 0xfe]);
    }

    #[test]
    fn images_of_another_size_are_refused_by_name() {
        let (_dir, folder) = folder();
        let one = folder.write_keyframe(&keyframe(1, 8, 6, 1)).expect("write");
        let other = folder.write_keyframe(&keyframe(2, 6, 8, 1)).expect("write");
        fs::copy(other.join("depth.png"), one.join("depth.png")).expect("copy");
        let message = folder.read_keyframe(1).expect_err("sizes differ").to_string();
        assert!(message.contains("depth.png") && message.contains("6 x 8") && message.contains("8 x 6"), "{message}");
        fs::copy(one.join("rgb.png"), one.join("depth.png")).expect("copy");
        let message = folder.read_keyframe(1).expect_err("colour for depth").to_string();
        assert!(message.contains("depth.png") && message.contains("pixel format"), "{message}");
        fs::remove_file(one.join("depth.png")).expect("remove");
        assert!(folder.read_keyframe(1).expect_err("missing").to_string().contains("depth.png"));
    }

    #[test]
    fn wild_numbers_in_the_json_are_refused_by_name() {
        let (_dir, folder) = folder();
        let path = folder.write_keyframe(&keyframe(1, 8, 6, 1)).expect("write").join("frame.json");
        let good = fs::read_to_string(&path).expect("read");
        for (from, to, field) in [
            ("\"id\": 1", "\"id\": 9", "id"),
            ("\"width\": 8", "\"width\": 4000000000", "intrinsics"),
            ("\"depth_unit_m\": 0.0002", "\"depth_unit_m\": 0.0", "depth_unit_m"),
            ("\"world_from_camera_xyzw\": [", "\"world_from_camera_xyzw\": [5.0, 0, 0, 0], \"x\": [", "xyzw"),
        ] {
            let bad = good.replace(from, to);
            assert_ne!(bad, good, "{from}");
            fs::write(&path, bad).expect("write");
            let message = folder.read_keyframe(1).expect_err(field).to_string();
            assert!(message.contains("frame.json") && message.contains(field), "{message}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn a_keyframe_survives_the_disk(width in 1..40u32, height in 1..30u32, seed: u32) {
            let (_dir, folder) = folder();
            let view = keyframe(5, width, height, seed);
            folder.write_keyframe(&view).expect("write");
            let back = folder.read_keyframe(5).expect("read").expect("there");
            prop_assert_eq!(&back.rgb, &view.rgb);
            prop_assert_eq!(&back.depth_units, &view.depth_units);
            assert_close(&view.frame.world_from_camera_position_m, &back.frame.world_from_camera_position_m);
            assert_close(&view.frame.world_from_camera_xyzw, &back.frame.world_from_camera_xyzw);
            prop_assert_eq!(back.frame.stamp_ns, view.frame.stamp_ns);
            prop_assert_eq!(back.frame.candidate, view.frame.candidate);
            let header = back.frame.header();
            let mut items = vec![0; header.items_len()];
            back.fill_items(&mut items);
            let channel = crate::messages::FrameView::new(&header, &items).expect("sane");
            prop_assert_eq!(channel.rgb, &view.rgb[..]);
            prop_assert_eq!(channel.depth_units_vec(), view.depth_units);
        }
    }

    #[test]
    fn a_file_cut_at_any_byte_is_an_error_that_names_it() {
        let (_dir, folder) = folder();
        let path = folder.write_keyframe(&keyframe(1, 9, 7, 3)).expect("write");
        for name in ["rgb.png", "depth.png", "frame.json"] {
            let file = path.join(name);
            let whole = fs::read(&file).expect("read");
            for length in 0..whole.len() {
                fs::write(&file, &whole[..length]).expect("cut");
                let message = folder.read_keyframe(1).expect_err("cut").to_string();
                assert!(message.contains(name), "{length} bytes of {name}: {message}");
            }
            fs::write(&file, &whole).expect("mend");
        }
        folder.read_keyframe(1).expect("mended");
    }

    #[test]
    fn a_damaged_byte_never_panics_and_never_changes_pixels_silently() {
        let (_dir, folder) = folder();
        let view = keyframe(1, 9, 7, 3);
        let path = folder.write_keyframe(&view).expect("write");
        for name in ["rgb.png", "depth.png"] {
            let file = path.join(name);
            let whole = fs::read(&file).expect("read");
            for index in 0..whole.len() {
                let mut bad = whole.clone();
                bad[index] ^= 0x55;
                fs::write(&file, bad).expect("damage");
                if let Ok(Some(back)) = folder.read_keyframe(1) {
                    assert_eq!(
                        (back.rgb, back.depth_units),
                        (view.rgb.clone(), view.depth_units.clone()),
                        "byte {index} of {name}"
                    );
                }
            }
            fs::write(&file, &whole).expect("mend");
        }
    }
}
