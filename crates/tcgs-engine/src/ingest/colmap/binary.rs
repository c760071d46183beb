//! Binary tables: little-endian records after a 64-bit count, which is checked against the bytes that follow.

use super::{
    super::{
        error::{IngestErrorKind, Result},
        points::Points,
        table_reader::TableReader,
    },
    ImageRecord, RecordCounter,
    cameras::{CameraRecord, MIN_PARAMETERS, model_by_number},
    push_point,
};

/// id, model, width, height and the fewest parameters.
const MIN_CAMERA_BYTES: usize = 4 + 4 + 8 + 8 + MIN_PARAMETERS * 8;
/// id, pose, camera, an empty name and no points.
pub(super) const MIN_IMAGE_BYTES: usize = 4 + 7 * 8 + 4 + 1 + 8;
/// x, y and the point's id.
const OBSERVATION: usize = 24;
/// id, position, color, error and an empty track.
const MIN_POINT_BYTES: usize = 8 + 24 + 3 + 8 + 8;
/// Image id and index.
const TRACK_ELEMENT: usize = 8;

/// `cameras.bin`.
pub(super) fn cameras(mut bytes: TableReader) -> Result<Vec<CameraRecord>> {
    let count = bytes.count("cameras", MIN_CAMERA_BYTES)?;
    RecordCounter::of("cameras").add(count)?;
    let mut cameras = Vec::with_capacity(count);
    for _ in 0..count {
        let id = bytes.u32("a camera's id")?;
        let (model, parameters) = model_by_number(id, bytes.i32("a camera's model")?)?;
        let width = bytes.u64("a camera's width")?;
        let height = bytes.u64("a camera's height")?;
        let parameters =
            (0..parameters).map(|_| bytes.f64("a camera's parameter")).collect::<Result<_, _>>()?;
        cameras.push(CameraRecord { id, model, width, height, parameters });
    }
    bytes.finish()?;
    Ok(cameras)
}

/// `images.bin`.
pub(super) fn images(mut bytes: TableReader) -> Result<Vec<ImageRecord>> {
    let count = bytes.count("images", MIN_IMAGE_BYTES)?;
    let mut counter = RecordCounter::of("images");
    counter.add(count)?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        let id = bytes.u32("an image's id")?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = bytes.f64("an image's pose")?;
        }
        let [w, x, y, z, tx, ty, tz] = pose;
        let camera = bytes.u32("an image's camera")?;
        let name = String::from_utf8(bytes.zero_terminated("an image's name")?).map_err(|_| {
            IngestErrorKind::Record {
                place: format!("image {id}"),
                message: "the name is not UTF-8 text".to_owned(),
            }
        })?;
        counter.name(&name)?;
        let observations = bytes.count("observations", OBSERVATION)?;
        bytes.skip("observations", observations * OBSERVATION)?;
        images.push(ImageRecord { id, quaternion: [w, x, y, z], translation: [tx, ty, tz], camera, name });
    }
    bytes.finish()?;
    Ok(images)
}

/// `points3D.bin`.
pub(super) fn points(mut bytes: TableReader, cloud: &mut Points) -> Result<()> {
    let count = bytes.count("points", MIN_POINT_BYTES)?;
    cloud.reserve(count)?;
    for _ in 0..count {
        let id = bytes.u64("a point's id")?;
        let position = [bytes.f64("a point's x")?, bytes.f64("a point's y")?, bytes.f64("a point's z")?];
        let color = [bytes.u8("a point's red")?, bytes.u8("a point's green")?, bytes.u8("a point's blue")?];
        bytes.f64("a point's error")?;
        let track = bytes.count("track elements", TRACK_ELEMENT)?;
        bytes.skip("track elements", track * TRACK_ELEMENT)?;
        push_point(cloud, id, position, color)?;
    }
    bytes.finish()
}

#[cfg(test)]
mod tests {
    use super::{super::super::limits::Limits, *};
    use crate::domain::PointCloud;

    fn cameras(table: &[u8]) -> Result<Vec<CameraRecord>> {
        super::cameras(TableReader::new(&mut &*table, table.len() as u64))
    }

    fn images(table: &[u8]) -> Result<Vec<ImageRecord>> {
        super::images(TableReader::new(&mut &*table, table.len() as u64))
    }

    fn points(table: &[u8]) -> Result<PointCloud> {
        let mut points = Points::new(true, 100);
        super::points(TableReader::new(&mut &*table, table.len() as u64), &mut points)?;
        Ok(points.into_cloud().expect("kept"))
    }

    fn camera_table() -> Vec<u8> {
        let mut table = 2_u64.to_le_bytes().to_vec();
        for (id, model, parameters) in
            [(1_u32, 1_i32, vec![50.0, 51.0, 32.0, 24.0]), (9, 2, vec![60.0, 32.0, 24.0, -0.1])]
        {
            table.extend(id.to_le_bytes());
            table.extend(model.to_le_bytes());
            table.extend(64_u64.to_le_bytes());
            table.extend(48_u64.to_le_bytes());
            table.extend(parameters.iter().flat_map(|value: &f64| value.to_le_bytes()));
        }
        table
    }

    fn image_table() -> Vec<u8> {
        let mut table = 2_u64.to_le_bytes().to_vec();
        for (id, name, observations) in [(4_u32, "a b.jpg", 2_u64), (5, "sub/c.jpg", 0)] {
            table.extend(id.to_le_bytes());
            table.extend(
                [1.0, 0.0, 0.0, 0.0, 0.5, -0.25, f64::from(id)].iter().flat_map(|value| value.to_le_bytes()),
            );
            table.extend(9_u32.to_le_bytes());
            table.extend(name.as_bytes());
            table.push(0);
            table.extend(observations.to_le_bytes());
            table.extend(vec![0xee; observations as usize * OBSERVATION]);
        }
        table
    }

    fn point_table() -> Vec<u8> {
        let mut table = 2_u64.to_le_bytes().to_vec();
        for (id, track) in [(11_u64, 3_u64), (12, 0)] {
            table.extend(id.to_le_bytes());
            table.extend([1.0, -2.0, id as f64].iter().flat_map(|value| value.to_le_bytes()));
            table.extend([10, 20, id as u8]);
            table.extend(0.5_f64.to_le_bytes());
            table.extend(track.to_le_bytes());
            table.extend(vec![0xee; track as usize * TRACK_ELEMENT]);
        }
        table
    }

    #[test]
    fn tables_are_read() {
        let cameras = cameras(&camera_table()).expect("cameras");
        assert_eq!(cameras.len(), 2);
        assert_eq!((cameras[1].id, cameras[1].model), (9, "SIMPLE_RADIAL"));
        assert_eq!(cameras[1].parameters, [60.0, 32.0, 24.0, -0.1]);
        let images = images(&image_table()).expect("images");
        assert_eq!(images[0].name, "a b.jpg");
        assert_eq!((images[1].id, images[1].camera, images[1].translation), (5, 9, [0.5, -0.25, 5.0]));
        let cloud = points(&point_table()).expect("points");
        assert_eq!(cloud.positions, [[1.0, -2.0, 11.0], [1.0, -2.0, 12.0]]);
        assert_eq!(cloud.colors, [[10, 20, 11], [10, 20, 12]]);
    }

    #[test]
    fn no_prefix_and_no_longer_table_is_accepted() {
        type Parser = fn(&[u8]) -> Option<IngestErrorKind>;
        let tables: [(Vec<u8>, Parser); 3] = [
            (camera_table(), |bytes| cameras(bytes).err()),
            (image_table(), |bytes| images(bytes).err()),
            (point_table(), |bytes| points(bytes).err()),
        ];
        for (table, error) in tables {
            assert!(error(&table).is_none());
            for length in 0..table.len() {
                let error = error(&table[..length]).expect("a prefix is no table");
                assert!(
                    matches!(error, IngestErrorKind::Truncated { .. } | IngestErrorKind::Count { .. }),
                    "{length}: {error}"
                );
            }
            let longer = [table.as_slice(), &[0]].concat();
            assert!(matches!(error(&longer), Some(IngestErrorKind::TrailingBytes(1))));
        }
    }

    #[test]
    fn flipped_bits_never_panic() {
        for (table, parse) in [
            (camera_table(), (|bytes| cameras(bytes).map(drop)) as fn(&[u8]) -> Result<()>),
            (image_table(), |bytes| images(bytes).map(drop)),
            (point_table(), |bytes| points(bytes).map(drop)),
        ] {
            for bit in 0..table.len() * 8 {
                let mut flipped = table.clone();
                flipped[bit / 8] ^= 1 << (bit % 8);
                // Many flips only change a value; the point is that none reads or allocates out of bounds.
                let _outcome = parse(&flipped);
            }
        }
    }

    #[test]
    fn claimed_counts_are_refused_before_memory_is_asked_for() {
        for table in [camera_table(), image_table(), point_table()] {
            let mut claims = table.clone();
            claims[..8].copy_from_slice(&u64::MAX.to_le_bytes());
            for error in [cameras(&claims).map(drop), images(&claims).map(drop), points(&claims).map(drop)] {
                assert!(matches!(error, Err(IngestErrorKind::Count { count: u64::MAX, .. })));
            }
        }
    }

    #[test]
    fn more_frames_and_longer_names_than_are_accepted_are_refused_before_they_are_gathered() {
        let mut many = (Limits::FRAMES as u64 + 1).to_le_bytes().to_vec();
        many.resize(8 + MIN_IMAGE_BYTES * (Limits::FRAMES + 1), 0);
        for error in [cameras(&many).err(), images(&many).err()] {
            assert!(
                matches!(error, Some(IngestErrorKind::TooManyRecords { limit: Limits::FRAMES, .. })),
                "{error:?}"
            );
        }
        let count = Limits::NAME_BYTES / 4000 + 1;
        let mut long = (count as u64).to_le_bytes().to_vec();
        for _ in 0..count {
            long.extend([0; MIN_IMAGE_BYTES - 9]);
            long.extend(vec![b'a'; 4000]);
            long.extend([0; 9]);
        }
        assert!(matches!(images(&long), Err(IngestErrorKind::TooManyNameBytes { .. })));
    }

    proptest::proptest! {
        #[test]
        fn arbitrary_tables_never_panic(
            count in 0_u64..5,
            rest in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..400),
        ) {
            let table = [&count.to_le_bytes()[..], &rest].concat();
            let _outcomes = (cameras(&table).is_ok(), images(&table).is_ok(), points(&table).is_ok());
        }
    }

    #[test]
    fn names_that_are_no_text_and_points_that_are_nowhere_are_refused() {
        let mut table = image_table();
        let name = table.windows(7).position(|window| window == b"a b.jpg").expect("the name");
        table[name] = 0xff;
        assert!(images(&table).expect_err("not text").to_string().starts_with("image 4: the name"));
        let mut table = point_table();
        table[16..24].copy_from_slice(&f64::NAN.to_le_bytes());
        let error = points(&table).expect_err("nowhere");
        assert_eq!(error.to_string(), "point 11: the position is not finite");
    }
}
