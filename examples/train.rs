//! Trains a scene on posed photographs and writes its file:
//! `cargo run --release --example train -- FOLDER_OR_ZIP scene.tcgs [STEPS]`.

use std::{env, error::Error, fs};

use tcgs_engine::{Dataset, TrainOptions, Trainer, encode};
use tcgs_render::gpu::{AdapterChoice, Device};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let (photographs, file, steps) = match &arguments[..] {
        [photographs, file] => (photographs, file, 1000),
        [photographs, file, steps] => (photographs, file, steps.parse()?),
        _ => return Err("usage: train FOLDER_OR_ZIP FILE [STEPS]".into()),
    };
    let device = Device::new(&AdapterChoice::default())?;
    let dataset = Dataset::load(photographs)?;
    dataset.notes.iter().for_each(|note| println!("{note}"));
    let options = TrainOptions { iterations: Some(steps), ..TrainOptions::default() };
    let trained = Trainer::new(&device, &dataset, &options).run(|progress| {
        let psnr = progress.psnr.unwrap_or_default();
        println!("step {} of {}: {} anchors, {psnr:.1} dB", progress.step, progress.total, progress.anchors);
    })?;
    let bytes = encode(&device, &dataset, &options, &trained)?;
    fs::write(file, &bytes)?;
    println!("{file}: {} bytes after {:.0} s of training", bytes.len(), trained.seconds);
    Ok(())
}
