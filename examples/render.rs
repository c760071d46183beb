//! Renders a `.tcgs` file from a position towards a target, both X,Y,Z in the units of its dataset:
//! `cargo run --release --example render -- scene.tcgs 2.6,-2.2,2.4 0,0,0.3 view.png`.

use std::{env, error::Error, fs};

use glam::DVec3;
use tcgs_codec::{
    DecodeLimits, decode,
    domain::{Camera, Intrinsics, Pose},
};
use tcgs_engine::picture::PictureFormat;
use tcgs_render::{
    Renderer,
    gpu::{AdapterChoice, Device},
};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [file, position, target, picture] = &arguments[..] else {
        return Err("usage: render FILE POSITION TARGET PICTURE.png".into());
    };
    let decoded = decode(&fs::read(file)?, &DecodeLimits::default())?;
    let device = Device::new(&AdapterChoice::default())?;
    let mut renderer = Renderer::new(&device, &decoded.scene, decoded.manifest.background)?;
    let pose = Pose::look_at(point(position)?, point(target)?, DVec3::Z)?;
    let intrinsics = Intrinsics { fx: 800.0, fy: 800.0, cx: 400.0, cy: 300.0, width: 800, height: 600 };
    let image = renderer.render(&Camera::new(intrinsics, pose)?)?;
    fs::write(picture, PictureFormat::Png.encode(&image)?)?;
    Ok(())
}

fn point(text: &str) -> Result<DVec3, Box<dyn Error>> {
    let numbers = text.split(',').map(str::parse).collect::<Result<Vec<f64>, _>>()?;
    let [x, y, z] = numbers[..] else { return Err(format!("{text} is not X,Y,Z").into()) };
    Ok(DVec3::new(x, y, z))
}
