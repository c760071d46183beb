//! A `.tcgs` file in a browser: decoded and rendered in a worker of the page.
//!
//! What always holds: decoding gives the bits that it gives everywhere; views are made by the kernels that the service uses; an error
//! is a string that can be shown to a person.

#![cfg(target_arch = "wasm32")]

use js_sys::{Error, Float32Array, Uint8Array};
use serde_json::json;
use tcgs_codec::{
    DecodeLimits, Decoded, decode,
    domain::{Camera, Scene, ViewRequest, view::View},
};
use tcgs_render::PageRenderer;
use wasm_bindgen::prelude::wasm_bindgen;
use web_sys::OffscreenCanvas;

/// Most memory that a scene may take: a page has 4 GiB at most.
const MAX_MEMORY_BYTES: u64 = 2 << 30;

/// A decoded file.
#[wasm_bindgen]
pub struct SceneFile(Decoded);

/// A file on a canvas.
#[wasm_bindgen]
pub struct Viewer(PageRenderer);

/// Lets a fault of this program end in the page's error handler with its text.
#[wasm_bindgen(start)]
fn begin() {
    std::panic::set_hook(Box::new(|fault| wasm_bindgen::throw_str(&fault.to_string())));
}

#[wasm_bindgen]
impl SceneFile {
    /// Decodes the bytes of a `.tcgs` file.
    ///
    /// # Errors
    /// What is wrong with the file.
    pub fn decode(bytes: &[u8]) -> Result<SceneFile, Error> {
        let limits = DecodeLimits { max_memory_bytes: MAX_MEMORY_BYTES, ..DecodeLimits::default() };
        decode(bytes, &limits).map(Self).map_err(shown)
    }

    /// The counts of the file and the SHA-256 of its decoded attributes, as JSON.
    pub fn summary(&self) -> String {
        let Decoded { scene, manifest, decode_sha256 } = &self.0;
        json!({
            "anchors": scene.len(),
            "gaussians": manifest.gaussians,
            "decode_sha256": decode_sha256.to_string(),
        })
        .to_string()
    }

    /// Opens WebGPU's device for `canvas` and brings the scene there.
    ///
    /// # Errors
    /// There is no adapter, or it is too small for the scene.
    pub async fn show(self, canvas: OffscreenCanvas) -> Result<Viewer, Error> {
        let Decoded { scene, manifest, .. } = self.0;
        let opened = PageRenderer::open(canvas, &Scene::Anchors(scene), manifest.background).await;
        opened.map(Viewer).map_err(shown)
    }
}

#[wasm_bindgen]
impl Viewer {
    /// Draws the view of a camera, in the JSON of `POST /v1/jobs/{id}/views`, on the canvas.
    ///
    /// # Errors
    /// The camera is none, or the device fails.
    pub async fn draw(&mut self, camera: String) -> Result<(), Error> {
        self.0.draw(&read(&camera)?).await.map_err(shown)
    }

    /// The red, green and blue bytes of the view of a camera, row by row.
    ///
    /// # Errors
    /// As [`Viewer::draw`].
    pub async fn pixels(&mut self, camera: String) -> Result<Uint8Array, Error> {
        let image = self.0.render(&read(&camera)?).await.map_err(shown)?;
        Ok(Uint8Array::from(image.samples()))
    }

    /// The depths of the view of a camera in units of the scene's world, row by row; 0 where nothing is seen.
    ///
    /// # Errors
    /// As [`Viewer::draw`].
    pub async fn depth(&mut self, camera: String) -> Result<Float32Array, Error> {
        let depths = self.0.depth(&read(&camera)?).await.map_err(shown)?;
        Ok(Float32Array::from(depths.values.as_slice()))
    }
}

/// A camera from the JSON of a view.
fn read(camera: &str) -> Result<Camera, Error> {
    let request: ViewRequest = serde_json::from_str(camera).map_err(shown)?;
    match View::try_from(request).map_err(shown)? {
        View::Camera(camera) => Ok(camera),
        View::Frame { name, .. } => Err(shown(format!("a page knows no frame '{name}'"))),
    }
}

fn shown(error: impl ToString) -> Error {
    Error::new(&error.to_string())
}
