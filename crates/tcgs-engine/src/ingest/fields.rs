//! The fields of a transforms file, deserialized as they are read.
//!
//! Unknown fields are skipped without being stored, and known ones are bounded: frames and names by [`super::Limits`], a matrix by its
//! shape.

use std::fmt;

use serde::{
    Deserialize, Deserializer,
    de::{Error as _, IntoDeserializer as _, MapAccess, SeqAccess, Visitor, value},
};

use super::{masks::is_mask_field, plan::RecordCounter};

/// How much of a camera model's name is kept.
const MODEL_CHARS: usize = 40;

/// How much of a field's name, or of a JSON pointer, is kept.
const POINTER_CHARS: usize = 100;

/// Most bytes of a path of masks.
const PATH_BYTES: usize = 4096;

/// A transforms file.
#[derive(Debug)]
pub(super) struct Document {
    pub(super) camera: CameraFields,
    pub(super) frames: Vec<FrameFields>,
    pub(super) ply_file_path: Option<String>,
    /// The first path of masks that is stated for all frames.
    pub(super) mask: Option<MaskField>,
    pub(super) train_filenames: Option<Names>,
    pub(super) val_filenames: Option<Names>,
    pub(super) test_filenames: Option<Names>,
}

/// One frame of it.
#[derive(Debug)]
pub(super) struct FrameFields {
    pub(super) camera: CameraFields,
    pub(super) file_path: String,
    pub(super) transform_matrix: Matrix,
    /// The path of its mask; its pointer is from the frame.
    pub(super) mask: Option<MaskField>,
}

/// A field that names masks.
#[derive(Debug, PartialEq)]
pub(super) struct MaskField {
    /// JSON pointer to it.
    pub(super) pointer: String,
    /// The path that it states, if it states one and a file can have it.
    pub(super) path: Option<String>,
}

/// What may be stated once for all frames or for each of them.
#[derive(Debug, Default)]
pub(super) struct CameraFields {
    pub(super) camera_model: Option<String>,
    pub(super) is_fisheye: Option<bool>,
    pub(super) fl_x: Option<f64>,
    pub(super) fl_y: Option<f64>,
    pub(super) camera_angle_x: Option<f64>,
    pub(super) camera_angle_y: Option<f64>,
    pub(super) cx: Option<f64>,
    pub(super) cy: Option<f64>,
    pub(super) w: Option<f64>,
    pub(super) h: Option<f64>,
    pub(super) k1: Option<f64>,
    pub(super) k2: Option<f64>,
    pub(super) k3: Option<f64>,
    pub(super) k4: Option<f64>,
    pub(super) k5: Option<f64>,
    pub(super) k6: Option<f64>,
    pub(super) p1: Option<f64>,
    pub(super) p2: Option<f64>,
    /// Of FISHEYE624; `None` inside if they are not 12 numbers.
    pub(super) distortion_params: Option<Parameters>,
}

/// The twelve parameters of FISHEYE624: k0 to k5, p0, p1, s0 to s3; `None` for another number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Parameters(pub(super) Option<[f64; 12]>);

/// Rows of numbers; `None` if they are no matrix of 4 rows (or 3) of 4 numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Matrix(pub(super) Option<[[f64; 4]; 4]>);

/// File names.
#[derive(Debug, Default)]
pub(super) struct Names(pub(super) Vec<String>);

/// The name of a field.
#[derive(Clone, Copy, Deserialize)]
#[serde(field_identifier, rename_all = "snake_case")]
enum Field {
    Frames,
    PlyFilePath,
    TrainFilenames,
    ValFilenames,
    TestFilenames,
    FilePath,
    TransformMatrix,
    CameraModel,
    IsFisheye,
    FlX,
    FlY,
    CameraAngleX,
    CameraAngleY,
    Cx,
    Cy,
    W,
    H,
    K1,
    K2,
    K3,
    K4,
    K5,
    K6,
    P1,
    P2,
    DistortionParams,
    #[serde(other)]
    Other,
}

impl CameraFields {
    /// Reads the value of a field, or skips it if it is not one of a camera. Returns what names masks in it.
    fn read<'de, A: MapAccess<'de>>(
        &mut self,
        key: &Key,
        map: &mut A,
    ) -> Result<Option<MaskField>, A::Error> {
        let number = match key.field {
            Field::CameraModel => {
                self.camera_model = map.next_value::<Option<ModelName>>()?.map(|name| name.0);
                return Ok(None);
            }
            Field::IsFisheye => {
                self.is_fisheye = map.next_value()?;
                return Ok(None);
            }
            Field::DistortionParams => {
                self.distortion_params = map.next_value()?;
                return Ok(None);
            }
            Field::FlX => &mut self.fl_x,
            Field::FlY => &mut self.fl_y,
            Field::CameraAngleX => &mut self.camera_angle_x,
            Field::CameraAngleY => &mut self.camera_angle_y,
            Field::Cx => &mut self.cx,
            Field::Cy => &mut self.cy,
            Field::W => &mut self.w,
            Field::H => &mut self.h,
            Field::K1 => &mut self.k1,
            Field::K2 => &mut self.k2,
            Field::K3 => &mut self.k3,
            Field::K4 => &mut self.k4,
            Field::K5 => &mut self.k5,
            Field::K6 => &mut self.k6,
            Field::P1 => &mut self.p1,
            Field::P2 => &mut self.p2,
            _ => return Ok(map.next_value::<Unused>()?.mask_under(&key.name)),
        };
        *number = map.next_value()?;
        Ok(None)
    }
}

/// The name of a field as it is known, and as it is written if it is not.
struct Key {
    field: Field,
    name: String,
}

impl<'de> Deserialize<'de> for Key {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Name;

        impl Visitor<'_> for Name {
            type Value = Key;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("the name of a field")
            }

            fn visit_str<E: serde::de::Error>(self, name: &str) -> Result<Key, E> {
                let name_of_field: value::StrDeserializer<'_, E> = name.into_deserializer();
                let field = Field::deserialize(name_of_field)?;
                let name = if matches!(field, Field::Other) { cut(name) } else { String::new() };
                Ok(Key { field, name })
            }
        }

        deserializer.deserialize_str(Name)
    }
}

/// A value that is not used, of which only paths of masks are of interest.
struct Unused {
    /// Whether it is a text, an array or an object with anything in it.
    has_content: bool,
    /// The text that it is, unless that is too long for a file's name.
    text: Option<String>,
    /// The first path of masks in it; its pointer is from the value.
    mask: Option<MaskField>,
}

impl Unused {
    const NOTHING: Self = Self { has_content: false, text: None, mask: None };

    /// What names masks, from the parent, if the value stands under this name.
    fn mask_under(self, name: &str) -> Option<MaskField> {
        if self.has_content && is_mask_field(name) {
            return Some(MaskField { pointer: cut(&format!("/{name}")), path: self.text });
        }
        self.mask.map(|rest| MaskField { pointer: cut(&format!("/{name}{}", rest.pointer)), ..rest })
    }
}

impl<'de> Deserialize<'de> for Unused {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Value;

        impl<'de> Visitor<'de> for Value {
            type Value = Unused;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("any value")
            }

            fn visit_unit<E>(self) -> Result<Unused, E> {
                Ok(Unused::NOTHING)
            }

            fn visit_bool<E>(self, _: bool) -> Result<Unused, E> {
                Ok(Unused::NOTHING)
            }

            fn visit_i64<E>(self, _: i64) -> Result<Unused, E> {
                Ok(Unused::NOTHING)
            }

            fn visit_u64<E>(self, _: u64) -> Result<Unused, E> {
                Ok(Unused::NOTHING)
            }

            fn visit_f64<E>(self, _: f64) -> Result<Unused, E> {
                Ok(Unused::NOTHING)
            }

            fn visit_str<E>(self, text: &str) -> Result<Unused, E> {
                let kept = (text.len() <= PATH_BYTES).then(|| text.to_owned());
                Ok(Unused { has_content: !text.is_empty(), text: kept, mask: None })
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<Unused, A::Error> {
                let mut unused = Unused::NOTHING;
                let mut index = 0_usize;
                while let Some(element) = sequence.next_element::<Unused>()? {
                    unused.has_content = true;
                    unused.mask = unused.mask.or_else(|| element.mask_under(&index.to_string()));
                    index += 1;
                }
                Ok(unused)
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Unused, A::Error> {
                let mut unused = Unused::NOTHING;
                while let Some(key) = map.next_key::<String>()? {
                    let value: Unused = map.next_value()?;
                    unused.has_content = true;
                    unused.mask = unused.mask.or_else(|| value.mask_under(&key));
                }
                Ok(unused)
            }
        }

        deserializer.deserialize_any(Value)
    }
}

/// As much of a text as a message repeats.
fn cut(text: &str) -> String {
    text.chars().take(POINTER_CHARS).collect()
}

impl<'de> Deserialize<'de> for Document {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Fields;

        impl<'de> Visitor<'de> for Fields {
            type Value = Document;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("an object with frames")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Document, A::Error> {
                let mut camera = CameraFields::default();
                let mut frames: Option<Frames> = None;
                let (mut ply_file_path, mut mask) = (None, None);
                let (mut train_filenames, mut val_filenames, mut test_filenames) = (None, None, None);
                while let Some(key) = map.next_key::<Key>()? {
                    match key.field {
                        Field::Frames if frames.is_some() => return Err(A::Error::duplicate_field("frames")),
                        Field::Frames => frames = Some(map.next_value()?),
                        Field::PlyFilePath => ply_file_path = map.next_value()?,
                        Field::TrainFilenames => train_filenames = map.next_value()?,
                        Field::ValFilenames => val_filenames = map.next_value()?,
                        Field::TestFilenames => test_filenames = map.next_value()?,
                        _ => mask = camera.read(&key, &mut map)?.or(mask),
                    }
                }
                let frames = frames.ok_or_else(|| A::Error::missing_field("frames"))?.0;
                Ok(Document {
                    camera,
                    frames,
                    ply_file_path,
                    mask,
                    train_filenames,
                    val_filenames,
                    test_filenames,
                })
            }
        }

        deserializer.deserialize_map(Fields)
    }
}

impl<'de> Deserialize<'de> for FrameFields {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Fields;

        impl<'de> Visitor<'de> for Fields {
            type Value = FrameFields;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("an object with file_path and transform_matrix")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<FrameFields, A::Error> {
                let mut camera = CameraFields::default();
                let (mut file_path, mut matrix, mut mask) = (None, None, None);
                while let Some(key) = map.next_key::<Key>()? {
                    match key.field {
                        Field::FilePath => file_path = Some(map.next_value()?),
                        Field::TransformMatrix => matrix = Some(map.next_value()?),
                        _ => mask = camera.read(&key, &mut map)?.or(mask),
                    }
                }
                let file_path = file_path.ok_or_else(|| A::Error::missing_field("file_path"))?;
                let matrix = matrix.ok_or_else(|| A::Error::missing_field("transform_matrix"))?;
                Ok(FrameFields { camera, file_path, transform_matrix: matrix, mask })
            }
        }

        deserializer.deserialize_map(Fields)
    }
}

/// The frames, as many as may be listed.
struct Frames(Vec<FrameFields>);

impl<'de> Deserialize<'de> for Frames {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut counter = RecordCounter::of("frames");
        gathered(deserializer, "an array of frames", move |frame: &FrameFields| {
            counter.add(1)?;
            counter.name(&frame.file_path)?;
            let mask = frame.mask.as_ref().and_then(|mask| mask.path.as_deref());
            mask.map_or(Ok(()), |path| counter.name(path))
        })
        .map(Self)
    }
}

impl<'de> Deserialize<'de> for Names {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut counter = RecordCounter::of("file names");
        gathered(deserializer, "an array of file names", move |name: &String| {
            counter.add(1)?;
            counter.name(name)
        })
        .map(Self)
    }
}

/// An array whose elements are counted by `count`, which may refuse one.
fn gathered<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
    expected: &'static str,
    count: impl FnMut(&T) -> Result<(), super::IngestErrorKind>,
) -> Result<Vec<T>, D::Error> {
    struct Elements<T, F>(&'static str, F, std::marker::PhantomData<T>);

    impl<'de, T: Deserialize<'de>, F: FnMut(&T) -> Result<(), super::IngestErrorKind>> Visitor<'de>
        for Elements<T, F>
    {
        type Value = Vec<T>;

        fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
            f.write_str(self.0)
        }

        fn visit_seq<A: SeqAccess<'de>>(mut self, mut sequence: A) -> Result<Vec<T>, A::Error> {
            let mut elements = Vec::new();
            while let Some(element) = sequence.next_element()? {
                (self.1)(&element).map_err(A::Error::custom)?;
                elements.push(element);
            }
            Ok(elements)
        }
    }

    deserializer.deserialize_seq(Elements(expected, count, std::marker::PhantomData))
}

impl<'de> Deserialize<'de> for Matrix {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let rows = UpTo::<UpTo<f64, 4>, 4>::deserialize(deserializer)?;
        if !(3..=4).contains(&rows.count) || rows.values[..rows.count].iter().any(|row| row.count != 4) {
            return Ok(Self(None));
        }
        let mut matrix = [[0.0; 4], [0.0; 4], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
        for (row, read) in matrix.iter_mut().zip(&rows.values[..rows.count]) {
            *row = read.values;
        }
        Ok(Self(Some(matrix)))
    }
}

impl<'de> Deserialize<'de> for Parameters {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let UpTo { values, count } = UpTo::<f64, 12>::deserialize(deserializer)?;
        Ok(Self((count == values.len()).then_some(values)))
    }
}

/// The first elements of an array, and how many there were.
#[derive(Clone, Copy)]
struct UpTo<T, const N: usize> {
    values: [T; N],
    count: usize,
}

impl<T: Default + Copy, const N: usize> Default for UpTo<T, N> {
    fn default() -> Self {
        Self { values: [T::default(); N], count: 0 }
    }
}

impl<'de, T: Deserialize<'de> + Default + Copy, const N: usize> Deserialize<'de> for UpTo<T, N> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Elements<T, const N: usize>(std::marker::PhantomData<T>);

        impl<'de, T: Deserialize<'de> + Default + Copy, const N: usize> Visitor<'de> for Elements<T, N> {
            type Value = UpTo<T, N>;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("rows of numbers")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<UpTo<T, N>, A::Error> {
                let mut sized = UpTo::default();
                while let Some(value) = sequence.next_element()? {
                    if let Some(place) = sized.values.get_mut(sized.count) {
                        *place = value;
                    }
                    sized.count += 1;
                }
                Ok(sized)
            }
        }

        deserializer.deserialize_seq(Elements(std::marker::PhantomData))
    }
}

/// The beginning of a camera model's name.
struct ModelName(String);

impl<'de> Deserialize<'de> for ModelName {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Name;

        impl Visitor<'_> for Name {
            type Value = ModelName;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("the name of a camera model")
            }

            fn visit_str<E>(self, name: &str) -> Result<ModelName, E> {
                Ok(ModelName(name.chars().take(MODEL_CHARS).collect()))
            }
        }

        deserializer.deserialize_str(Name)
    }
}

#[cfg(test)]
mod tests {
    use super::{super::Limits, *};

    fn parsed(text: &str) -> serde_json::Result<Document> {
        serde_json::from_str(text)
    }

    const FRAME: &str = r#"{"file_path": "a", "transform_matrix": [[1,0,0,5],[0,1,0,6],[0,0,1,7]]}"#;

    #[test]
    fn fields_are_found_in_any_order_among_others() {
        let document = parsed(&format!(
            r#"{{"other": [[], {{"fl_x": 3}}], "frames": [{FRAME}], "fl_x": 2, "camera_model": "OPENCV", "w": null,
                "k4": 0.5, "test_filenames": ["a"], "is_fisheye": false, "camera_angle_y": 1.5}}"#
        ))
        .expect("a document");
        assert_eq!((document.camera.fl_x, document.camera.k4), (Some(2.0), Some(0.5)));
        assert_eq!((document.camera.w, document.camera.camera_angle_y), (None, Some(1.5)));
        assert_eq!(document.camera.camera_model.as_deref(), Some("OPENCV"));
        assert_eq!(document.test_filenames.expect("a list").0, ["a"]);
        let frame = &document.frames[0];
        assert_eq!((frame.file_path.as_str(), &frame.mask, &document.mask), ("a", &None, &None));
        let matrix = [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 6.0], [0.0, 0.0, 1.0, 7.0], [0.0, 0.0, 0.0, 1.0]];
        assert_eq!(frame.transform_matrix, Matrix(Some(matrix)));
    }

    #[test]
    fn paths_of_masks_are_found_at_any_level() {
        let pointer = |mask: &Option<MaskField>| mask.as_ref().map(|mask| mask.pointer.clone());
        let frame = FRAME.strip_suffix('}').expect("an object");
        for (text, shared, own) in [
            (format!(r#"{{"mask_path": "m.png", "frames": [{FRAME}]}}"#), Some("/mask_path"), None),
            (format!(r#"{{"frames": [{frame}, "mask_path": "m.png"}}]}}"#), None, Some("/mask_path")),
            (
                format!(r#"{{"frames": [{frame}, "dynamic_masks": ["m.png"]}}]}}"#),
                None,
                Some("/dynamic_masks"),
            ),
            (
                format!(r#"{{"meta": [1, {{"masks": {{"a": "m.png"}}}}], "frames": [{FRAME}]}}"#),
                Some("/meta/1/masks"),
                None,
            ),
            (
                format!(r#"{{"mask_path": null, "masks": [], "frames": [{frame}, "mask_path": ""}}]}}"#),
                None,
                None,
            ),
            (format!(r#"{{"has_mask": true, "mask_color": "red", "frames": [{FRAME}]}}"#), None, None),
        ] {
            let document = parsed(&text).expect("a document");
            assert_eq!(
                (pointer(&document.mask), pointer(&document.frames[0].mask)),
                (shared.map(str::to_owned), own.map(str::to_owned)),
                "{text}"
            );
        }
        let deep = format!(r#"{{"{}": {{"mask_path": "m"}}, "frames": []}}"#, "x".repeat(5000));
        assert_eq!(parsed(&deep).expect("a document").mask.expect("masks").pointer.len(), POINTER_CHARS);
    }

    #[test]
    fn matrices_of_other_shapes_are_none_and_of_other_types_refused() {
        for rows in
            ["[]", "[[]]", "[[1,2,3,4],[1,2,3,4]]", "[[1,2,3,4],[1,2,3,4],[1,2,3]]", "[[1,2,3,4,5],[],[]]"]
        {
            assert_eq!(serde_json::from_str::<Matrix>(rows).expect(rows), Matrix(None), "{rows}");
        }
        for rows in ["[1,2,3,4]", "{}", "[[\"1\"]]", "[[null]]"] {
            assert!(serde_json::from_str::<Matrix>(rows).is_err(), "{rows}");
        }
    }

    #[test]
    fn what_is_missing_twice_or_too_much_is_refused_by_name() {
        let names = |name: &str, count: usize| format!("[{}]", vec![format!("\"{name}\""); count].join(","));
        let frames = vec![FRAME; Limits::FRAMES + 1].join(",");
        for (text, words) in [
            ("{}".to_owned(), "missing field `frames`"),
            (r#"{"frames": [{"file_path": "a"}]}"#.to_owned(), "missing field `transform_matrix`"),
            (r#"{"frames": [], "frames": []}"#.to_owned(), "duplicate field `frames`"),
            (format!(r#"{{"frames": [{frames}]}}"#), "lists more than 20000 frames"),
            (
                format!(r#"{{"frames": [], "val_filenames": {}}}"#, names("a", Limits::FRAMES + 1)),
                "more than 20000 file names",
            ),
            (
                format!(r#"{{"frames": [], "val_filenames": {}}}"#, names(&"a".repeat(10_000), 700)),
                "bytes together",
            ),
        ] {
            let error = parsed(&text).expect_err(words).to_string();
            assert!(error.contains(words), "'{error}' should say '{words}'");
        }
    }

    proptest::proptest! {
        #[test]
        fn arbitrary_documents_never_panic(text in r#"(\{|\}|\[|\]|,|:|"frames"|"file_path"|"transform_matrix"|"fl_x"|[0-9]{1,3}|null){0,40}"#) {
            let _outcome = parsed(&text);
        }
    }
}
