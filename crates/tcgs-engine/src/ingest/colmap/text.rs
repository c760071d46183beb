//! Text tables: one record a line (two for images); `#` starts a comment line.
//!
//! Lines are read one at a time. Only the beginning of a long line is kept, which has all fields that are used; observations and tracks
//! follow it.

use std::{
    io::{self, BufRead},
    str::FromStr,
};

use super::{
    super::{
        error::{IngestErrorKind, Result},
        points::Points,
    },
    ImageRecord, RecordCounter,
    cameras::{CameraRecord, model_by_name},
    push_point,
};

/// How much of a line is held: a name of 4096 bytes with the numbers before it, and to spare.
const HEAD_BYTES: usize = 16 << 10;

/// How much of a word of observations is held: any 64-bit number, and to spare.
const WORD_BYTES: usize = 24;

/// `cameras.txt`: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`.
pub(super) fn cameras(lines: &mut Lines) -> Result<Vec<CameraRecord>> {
    let mut cameras = Vec::new();
    let mut counter = RecordCounter::of("cameras");
    while let Some(line) = lines.next_record()? {
        let mut fields = line.fields();
        let id = fields.next("CAMERA_ID")?;
        let (model, count) = model_by_name(id, fields.word("MODEL")?)?;
        let width = fields.next("WIDTH")?;
        let height = fields.next("HEIGHT")?;
        let parameters: Vec<f64> = (0..count).map(|_| fields.next("PARAMS")).collect::<Result<_, _>>()?;
        if fields.words.next().is_some() {
            return Err(line.error(format!("{model} has {count} parameters and more are given")));
        }
        counter.add(1)?;
        cameras.push(CameraRecord { id, model, width, height, parameters });
    }
    Ok(cameras)
}

/// `images.txt`: `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, then a line of `X Y POINT3D_ID` triples.
pub(super) fn images(lines: &mut Lines) -> Result<Vec<ImageRecord>> {
    let mut images = Vec::new();
    let mut counter = RecordCounter::of("images");
    while let Some(line) = lines.next_record()? {
        let mut fields = line.fields();
        let id = fields.next("IMAGE_ID")?;
        let quaternion = [fields.next("QW")?, fields.next("QX")?, fields.next("QY")?, fields.next("QZ")?];
        let translation = [fields.next("TX")?, fields.next("TY")?, fields.next("TZ")?];
        let camera = fields.next("CAMERA_ID")?;
        // Names may contain spaces, so the name is all that is left.
        let name = line.after(9).ok_or_else(|| line.error("NAME is missing".to_owned()))?.to_owned();
        counter.add(1)?;
        counter.name(&name)?;
        images.push(ImageRecord { id, quaternion, translation, camera, name });
        // The line of points is there even if the image has none; it is only checked for being one, because
        // without it every second image would be taken for points and lost.
        if !lines.pass_triples()? {
            let message = "expected the POINTS2D line of the image above (X Y POINT3D_ID triples)";
            return Err(error(lines.number, message.to_owned()));
        }
    }
    Ok(images)
}

/// How many images `images.txt` lists, each with its line of points. Poses are not looked at.
pub(super) fn count_images(lines: &mut Lines) -> Result<u64> {
    let mut count = 0;
    while let Some(line) = lines.next_record()? {
        let _: u32 = line.fields().next("IMAGE_ID")?;
        line.after(9).ok_or_else(|| line.error("NAME is missing".to_owned()))?;
        if !lines.pass_triples()? {
            return Err(error(lines.number, "expected a line of points".to_owned()));
        }
        count += 1;
    }
    Ok(count)
}

/// `points3D.txt`: `POINT3D_ID X Y Z R G B ERROR TRACK[]`.
pub(super) fn points(lines: &mut Lines, cloud: &mut Points) -> Result<()> {
    while let Some(line) = lines.next_record()? {
        let mut fields = line.fields();
        let id = fields.next("POINT3D_ID")?;
        let position = [fields.next("X")?, fields.next("Y")?, fields.next("Z")?];
        let color = [fields.next("R")?, fields.next("G")?, fields.next("B")?];
        let _: f64 = fields.next("ERROR")?;
        push_point(cloud, id, position, color)?;
    }
    Ok(())
}

/// The lines of a table.
pub(super) struct Lines<'a> {
    reader: &'a mut dyn BufRead,
    /// Of the line that was read last, from 1.
    number: usize,
    head: Vec<u8>,
}

impl<'a> Lines<'a> {
    /// From the first line on.
    pub(super) fn new(reader: &'a mut dyn BufRead) -> Self {
        Self { reader, number: 0, head: Vec::new() }
    }

    /// The beginning of the next line that is a record.
    fn next_record(&mut self) -> Result<Option<Line<'_>>> {
        loop {
            let mut head = std::mem::take(&mut self.head);
            head.clear();
            let read = self.pass_line(|bytes| {
                let room = HEAD_BYTES.saturating_sub(head.len());
                head.extend_from_slice(&bytes[..bytes.len().min(room)]);
            })?;
            self.head = head;
            if !read {
                return Ok(None);
            }
            let text = self.head.trim_ascii_start();
            if !text.is_empty() && !text.starts_with(b"#") {
                break;
            }
        }
        let text = match std::str::from_utf8(&self.head) {
            Ok(text) => text,
            // Cut off within a character.
            Err(error) if error.error_len().is_none() && self.head.len() == HEAD_BYTES => {
                std::str::from_utf8(&self.head[..error.valid_up_to()]).unwrap_or_default()
            }
            Err(_) => return Err(error(self.number, "it is not UTF-8 text".to_owned())),
        };
        Ok(Some(Line { number: self.number, text: text.trim() }))
    }

    /// Skips a line and returns whether it consists of triples whose third word is a whole number. The end of the table counts as
    /// an empty line.
    fn pass_triples(&mut self) -> Result<bool> {
        let (mut words, mut word, mut good) = (0_usize, Vec::with_capacity(WORD_BYTES), true);
        let mut end = |word: &mut Vec<u8>| {
            if !word.is_empty() {
                words += 1;
                let text = std::str::from_utf8(word).unwrap_or_default();
                good &= words % 3 != 0 || text.parse::<i64>().is_ok();
                word.clear();
            }
        };
        self.pass_line(|bytes| {
            for byte in bytes {
                if byte.is_ascii_whitespace() {
                    end(&mut word);
                } else if word.len() < WORD_BYTES {
                    word.push(*byte);
                }
            }
        })?;
        end(&mut word);
        Ok(good && words % 3 == 0)
    }

    /// Shows a line's bytes, piece by piece and without its end, and says whether there was one.
    fn pass_line(&mut self, mut show: impl FnMut(&[u8])) -> Result<bool> {
        let mut any = false;
        loop {
            let bytes = match self.reader.fill_buf() {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                read => read?,
            };
            if bytes.is_empty() {
                break;
            }
            any = true;
            let end = bytes.iter().position(|byte| *byte == b'\n');
            let length = end.unwrap_or(bytes.len());
            show(&bytes[..length]);
            self.reader.consume(length + usize::from(end.is_some()));
            if end.is_some() {
                break;
            }
        }
        self.number += usize::from(any);
        Ok(any)
    }
}

fn error(line: usize, message: String) -> IngestErrorKind {
    IngestErrorKind::Record { place: format!("line {line}"), message }
}

#[derive(Clone, Copy)]
struct Line<'a> {
    number: usize,
    text: &'a str,
}

impl<'a> Line<'a> {
    fn fields(self) -> Fields<'a> {
        Fields { line: self, words: self.text.split_ascii_whitespace() }
    }

    /// What follows the first `words` words.
    fn after(&self, words: usize) -> Option<&'a str> {
        let mut rest = self.text;
        for _ in 0..words {
            let end = rest.find(|c: char| c.is_ascii_whitespace())?;
            rest = rest[end..].trim_start();
        }
        (!rest.is_empty()).then_some(rest)
    }

    fn error(&self, message: String) -> IngestErrorKind {
        error(self.number, message)
    }
}

struct Fields<'a> {
    line: Line<'a>,
    words: std::str::SplitAsciiWhitespace<'a>,
}

impl<'a> Fields<'a> {
    fn word(&mut self, name: &str) -> Result<&'a str> {
        self.words.next().ok_or_else(|| self.line.error(format!("{name} is missing")))
    }

    fn next<T: FromStr>(&mut self, name: &str) -> Result<T> {
        let word = self.word(name)?;
        word.parse().map_err(|_| self.line.error(format!("{name} is '{word:.40}', which cannot be read")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::PointCloud;

    fn cameras(text: &str) -> Result<Vec<CameraRecord>> {
        super::cameras(&mut Lines::new(&mut text.as_bytes()))
    }

    fn images(text: &str) -> Result<Vec<ImageRecord>> {
        super::images(&mut Lines::new(&mut text.as_bytes()))
    }

    fn points(text: &str) -> Result<PointCloud> {
        let mut points = Points::new(true, 100);
        super::points(&mut Lines::new(&mut text.as_bytes()), &mut points)?;
        Ok(points.into_cloud().expect("kept"))
    }

    const CAMERAS: &str =
        "# a comment\n\n1 PINHOLE 768 512 689.87 691.04 380.1 251.7\r\n2 SIMPLE_RADIAL 64 48 50 32 24 -0.1\n";
    const IMAGES: &str = "# comment\n1 1 0 0 0 0.5 -0.25 3 1 a b.jpg\n1.5 2.5 -1 3 4 17\n2 0 1 0 0 0 0 0 2 c.jpg\n\n3 0 0 1 0 0 0 0 2 d.jpg";
    const POINTS: &str = "# comment\n7 1 -2 3.5 10 20 255 0.5 1 0 2 5\n8 0 0 0 0 0 0 -1\n";

    #[test]
    fn tables_are_read() {
        let cameras = cameras(CAMERAS).expect("cameras");
        assert_eq!((cameras[0].model, cameras[0].width, cameras[0].height), ("PINHOLE", 768, 512));
        assert_eq!(cameras[1].parameters, [50.0, 32.0, 24.0, -0.1]);
        let images = images(IMAGES).expect("images");
        let names: Vec<&str> = images.iter().map(|image| image.name.as_str()).collect();
        assert_eq!(names, ["a b.jpg", "c.jpg", "d.jpg"]);
        assert_eq!((images[0].translation, images[2].quaternion), ([0.5, -0.25, 3.0], [0.0, 0.0, 1.0, 0.0]));
        let cloud = points(POINTS).expect("points");
        assert_eq!(cloud.positions, [[1.0, -2.0, 3.5], [0.0; 3]]);
        assert_eq!(cloud.colors, [[10, 20, 255], [0; 3]]);
    }

    #[test]
    fn faults_name_the_line_and_the_field() {
        for (error, expected) in [
            (cameras("1 PINHOLE 768 512 689.87 691.04 380.1").err(), "line 1: PARAMS is missing"),
            (
                cameras("1 PINHOLE 768 512 1 2 3 4 5").err(),
                "line 1: PINHOLE has 4 parameters and more are given",
            ),
            (cameras("x PINHOLE").err(), "line 1: CAMERA_ID is 'x', which cannot be read"),
            (cameras("1 PINHOLE -5 5 1 1 1 1").err(), "line 1: WIDTH is '-5', which cannot be read"),
            (images("#\n1 1 0 0 0 0 0 0 1").err(), "line 2: NAME is missing"),
            (images("1 1 0 0 0 0 0").err(), "line 1: TZ is missing"),
            (
                images("1 1 0 0 0 0 0 0 1 a.jpg\n2 1 0 0 0 0 0 0 1 b.jpg\n").err(),
                "line 2: expected the POINTS2D line of the image above (X Y POINT3D_ID triples)",
            ),
            (points("1 1 2 3 256 0 0 0").err(), "line 1: R is '256', which cannot be read"),
            (points("1 1 2 inf 25 0 0 0").err(), "point 1: the position is not finite"),
            (points("1 1 2 3 25 0 0").err(), "line 1: ERROR is missing"),
        ] {
            assert_eq!(error.expect(expected).to_string(), expected);
        }
    }

    #[test]
    fn cut_tables_never_panic() {
        for table in [CAMERAS, IMAGES, POINTS] {
            for length in 0..table.len() {
                let cut = &table[..length];
                let _outcomes = (cameras(cut).is_ok(), images(cut).is_ok(), points(cut).is_ok());
            }
        }
    }

    #[test]
    fn of_long_lines_only_the_beginning_is_held() {
        let track = " 1 2".repeat(HEAD_BYTES);
        let cloud = points(&format!("7 1 2 3 4 5 6 0.5{track}\n8 1 2 3 4 5 6 0.5\n")).expect("points");
        assert_eq!(cloud.positions.len(), 2);
        let seen = "1.5 2.5 -1 ".repeat(HEAD_BYTES);
        let two = format!("1 1 0 0 0 0 0 0 1 a.png\n{seen}\n2 1 0 0 0 0 0 0 1 b.png\n\n");
        assert_eq!(images(&two).expect("images").len(), 2);
        let broken = format!("1 1 0 0 0 0 0 0 1 a.png\n{seen}x\n");
        assert!(images(&broken).expect_err("no triples").to_string().starts_with("line 2: expected"));
        let name = "ä".repeat(HEAD_BYTES);
        let long = images(&format!("1 1 0 0 0 0 0 0 1 {name}\n\n")).expect("an image");
        assert!(long[0].name.len() <= HEAD_BYTES, "the rule on names refuses it");
    }

    proptest::proptest! {
        #[test]
        fn arbitrary_tables_never_panic(text in "[ -~\n\u{e4}#0-9.]{0,300}") {
            let _outcomes = (cameras(&text).is_ok(), images(&text).is_ok(), points(&text).is_ok());
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..300)) {
            let _images = super::images(&mut Lines::new(&mut &bytes[..])).is_ok();
            let _points = super::points(&mut Lines::new(&mut &bytes[..]), &mut Points::new(true, 9)).is_ok();
        }
    }
}
