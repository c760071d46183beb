//! Text tables: one record a line (two for images), `#` starts a comment line.

use std::str::FromStr;

use super::{
    super::error::Fault,
    ImageRecord,
    cameras::{CameraRecord, model_by_name},
    push_point,
};
use crate::domain::PointCloud;

/// `cameras.txt`: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`.
pub(super) fn cameras(text: &str) -> Result<Vec<CameraRecord>, Fault> {
    let mut cameras = Vec::new();
    for line in records(text) {
        let mut fields = line.fields();
        let id = fields.next("CAMERA_ID")?;
        let (model, count) = model_by_name(id, fields.word("MODEL")?)?;
        let width = fields.next("WIDTH")?;
        let height = fields.next("HEIGHT")?;
        let parameters: Vec<f64> = (0..count).map(|_| fields.next("PARAMS")).collect::<Result<_, _>>()?;
        if fields.words.next().is_some() {
            return Err(line.fault(format!("{model} has {count} parameters and more are given")));
        }
        cameras.push(CameraRecord { id, model, width, height, parameters });
    }
    Ok(cameras)
}

/// `images.txt`: `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, then a line of `X Y POINT3D_ID` triples.
pub(super) fn images(text: &str) -> Result<Vec<ImageRecord>, Fault> {
    let mut images = Vec::new();
    let mut lines = Line::all(text);
    while let Some(line) = lines.next() {
        if !line.is_record() {
            continue;
        }
        let mut fields = line.fields();
        let id = fields.next("IMAGE_ID")?;
        let quaternion = [fields.next("QW")?, fields.next("QX")?, fields.next("QY")?, fields.next("QZ")?];
        let translation = [fields.next("TX")?, fields.next("TY")?, fields.next("TZ")?];
        let camera = fields.next("CAMERA_ID")?;
        // Names may contain spaces, so the name is all that is left.
        let name = line.after(9).ok_or_else(|| line.fault("NAME is missing".to_owned()))?;
        images.push(ImageRecord { id, quaternion, translation, camera, name: name.to_owned() });
        // The line of points is there even if the image has none; it is only checked for being one, because
        // without it every second image would be taken for points and lost.
        if let Some(points) = lines.next()
            && !points.is_triples()
        {
            return Err(points
                .fault("expected the POINTS2D line of the image above (X Y POINT3D_ID triples)".to_owned()));
        }
    }
    Ok(images)
}

/// `points3D.txt`: `POINT3D_ID X Y Z R G B ERROR TRACK[]`.
pub(super) fn points(text: &str) -> Result<PointCloud, Fault> {
    let mut cloud = PointCloud::default();
    for line in records(text) {
        let mut fields = line.fields();
        let id = fields.next("POINT3D_ID")?;
        let position = [fields.next("X")?, fields.next("Y")?, fields.next("Z")?];
        let color = [fields.next("R")?, fields.next("G")?, fields.next("B")?];
        let _: f64 = fields.next("ERROR")?;
        push_point(&mut cloud, id, position, color)?;
    }
    Ok(cloud)
}

fn records(text: &str) -> impl Iterator<Item = Line<'_>> {
    Line::all(text).filter(Line::is_record)
}

#[derive(Clone, Copy)]
struct Line<'a> {
    number: usize,
    text: &'a str,
}

impl<'a> Line<'a> {
    fn all(text: &'a str) -> impl Iterator<Item = Self> {
        text.lines().enumerate().map(|(index, text)| Self { number: index + 1, text: text.trim() })
    }

    fn is_record(&self) -> bool {
        !self.text.is_empty() && !self.text.starts_with('#')
    }

    fn is_triples(&self) -> bool {
        let words = || self.text.split_ascii_whitespace();
        words().count() % 3 == 0 && words().skip(2).step_by(3).all(|id| id.parse::<i64>().is_ok())
    }

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

    fn fault(&self, message: String) -> Fault {
        Fault::Record { place: format!("line {}", self.number), message }
    }
}

struct Fields<'a> {
    line: Line<'a>,
    words: std::str::SplitAsciiWhitespace<'a>,
}

impl<'a> Fields<'a> {
    fn word(&mut self, name: &str) -> Result<&'a str, Fault> {
        self.words.next().ok_or_else(|| self.line.fault(format!("{name} is missing")))
    }

    fn next<T: FromStr>(&mut self, name: &str) -> Result<T, Fault> {
        let word = self.word(name)?;
        word.parse().map_err(|_| self.line.fault(format!("{name} is '{word:.40}', which cannot be read")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        for (fault, expected) in [
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
            assert_eq!(fault.expect(expected).to_string(), expected);
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
}
