//! The still life, its light, and the radiance along a ray.
//!
//! Colors are linear light until [`Scene::render`] writes sRGB. Shadows and ambient light depend only on the
//! surface point, so views agree with each other; only the highlights move with the eye.

use glam::{DVec2, DVec3};
use libm::{cos, pow, sin};
use rayon::prelude::*;

use super::{
    shape::{MIN_DISTANCE, Ray, SampleShape, ball},
    texture::Texture,
};
use crate::domain::{Camera, Image};

/// Radius of the dome that carries the sky: far enough to move little between views, near enough to be geometry.
const SKY_RADIUS: f64 = 9.0;

/// Sub-pixel positions of the four samples of a pixel (a rotated grid).
const SUBPIXELS: [DVec2; 4] =
    [DVec2::new(0.375, 0.125), DVec2::new(0.875, 0.375), DVec2::new(0.125, 0.625), DVec2::new(0.625, 0.875)];

/// The one sample of a pixel of a large image.
const MIDDLE: [DVec2; 1] = [DVec2::new(0.5, 0.5)];

/// Most pixels of an image with four samples per pixel. Larger ones show edges finely enough, and would take minutes each.
const MAX_SUPERSAMPLED: u64 = 1_500_000;

/// Shadow rays a sample.
const SHADOW_RAYS: u32 = 8;

/// Tangent of the light's angular radius, which makes the shadows' edges soft.
const SUN_SPREAD: f64 = 0.045;

const SUN_COLOR: DVec3 = DVec3::new(1.05, 0.96, 0.82);
const SKY_LIGHT: DVec3 = DVec3::new(0.34, 0.40, 0.48);
const GROUND_LIGHT: DVec3 = DVec3::new(0.16, 0.13, 0.10);

/// A solid with its paint.
#[derive(Debug, Clone, Copy)]
pub(super) struct Solid {
    pub(super) shape: SampleShape,
    pub(super) texture: Texture,
    /// Strength of the highlight (Blinn-Phong), 0 for matt.
    gloss: f64,
    /// Exponent of the highlight.
    shininess: f64,
    /// Share of the point cloud.
    pub(super) points: f64,
}

/// Everything that can be seen, with its light.
pub(super) struct Scene {
    pub(super) solids: Vec<Solid>,
    /// Ball around the fence, which is many rods that most rays pass far from.
    fence: (DVec3, f64),
    /// Solids from this index on are rods of the fence.
    fence_from: usize,
    sun: DVec3,
}

/// Where a ray ends.
struct Hit {
    point: DVec3,
    normal: DVec3,
    solid: Solid,
}

impl Scene {
    /// The bundled still life.
    pub(super) fn still_life() -> Self {
        let matt = |shape, texture, points| Solid { shape, texture, gloss: 0.0, shininess: 1.0, points };
        let glossy =
            |shape, texture, gloss, shininess, points| Solid { shape, texture, gloss, shininess, points };
        let mut solids = vec![
            matt(SampleShape::Dome { radius: SKY_RADIUS }, Texture::Sky, 0.10),
            matt(SampleShape::Ground { radius: SKY_RADIUS }, Texture::Tiles, 0.36),
            glossy(
                SampleShape::Sphere { center: DVec3::new(-0.55, -0.55, 0.5), radius: 0.5 },
                Texture::Lacquer,
                0.9,
                70.0,
                0.12,
            ),
            matt(
                SampleShape::Block {
                    center: DVec3::new(0.7, -0.3, 0.35),
                    half: DVec3::new(0.35, 0.35, 0.35),
                    axis: DVec2::new(cos(0.5), sin(0.5)),
                },
                Texture::Patchwork,
                0.14,
            ),
            glossy(
                SampleShape::Torus { center: DVec3::new(0.25, 0.75, 0.14), major: 0.42, minor: 0.14 },
                Texture::Bands,
                0.18,
                24.0,
                0.10,
            ),
            matt(
                SampleShape::Cylinder { base: DVec3::new(-0.75, 0.6, 0.0), radius: 0.24, height: 1.1 },
                Texture::Helix,
                0.10,
            ),
        ];
        let fence_from = solids.len();
        let rods = fence();
        let share = 0.08 / rods.len() as f64;
        solids.extend(rods.into_iter().map(|(from, to, radius)| {
            let color = DVec3::new(0.20, 0.17, 0.15);
            glossy(SampleShape::Rod { from, to, radius }, Texture::Plain(color), 0.25, 30.0, share)
        }));
        let fence = bound_of(&solids[fence_from..]);
        Self { solids, fence, fence_from, sun: DVec3::new(0.45, -0.75, 1.0).normalize() }
    }

    /// The image of the scene from `camera`, four samples per pixel; one where there are more than [`MAX_SUPERSAMPLED`] pixels.
    pub(super) fn render(&self, camera: &Camera) -> Image {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let is_large = u64::from(width) * u64::from(height) > MAX_SUPERSAMPLED;
        let subpixels: &[DVec2] = if is_large { &MIDDLE } else { &SUBPIXELS };
        let rows: Vec<Vec<u8>> = (0..height)
            .into_par_iter()
            .map(|row| (0..width).flat_map(|column| self.pixel(camera, column, row, subpixels)).collect())
            .collect();
        Image::new(width, height, 3, rows.concat()).expect("a row of RGB for each row of the camera")
    }

    fn pixel(&self, camera: &Camera, column: u32, row: u32, subpixels: &[DVec2]) -> [u8; 3] {
        let mut light = DVec3::ZERO;
        for (sample, offset) in subpixels.iter().enumerate() {
            let at = DVec2::new(f64::from(column), f64::from(row)) + *offset;
            light += self.radiance(&ray_through(camera, at), sample);
        }
        (light / subpixels.len() as f64).to_array().map(srgb8)
    }

    /// Light along a ray; `sample` varies which points of the sun its shadow rays go to.
    fn radiance(&self, ray: &Ray, sample: usize) -> DVec3 {
        let Some(hit) = self.hit(ray) else { return DVec3::ZERO };
        let Solid { shape, texture, gloss, shininess, .. } = hit.solid;
        let albedo = texture.albedo(shape.local(hit.point), hit.normal);
        if matches!(shape, SampleShape::Dome { .. }) {
            return albedo;
        }
        let sunlight = self.sunlight(hit.point, hit.normal, sample);
        let mut light = self.diffuse(&hit, albedo, sunlight);
        if gloss > 0.0 {
            let half = (self.sun - ray.direction).normalize_or_zero();
            light += SUN_COLOR * (gloss * sunlight * pow(hit.normal.dot(half).max(0.0), shininess));
        }
        light
    }

    /// Color of a solid's surface point as sRGB, without the highlight, as in a point cloud.
    pub(super) fn matt_color(&self, solid: &Solid, point: DVec3) -> [u8; 3] {
        let normal = solid.shape.normal(point);
        let albedo = solid.texture.albedo(solid.shape.local(point), normal);
        if matches!(solid.shape, SampleShape::Dome { .. }) {
            return albedo.to_array().map(srgb8);
        }
        let samples = SUBPIXELS.len();
        let sunlight =
            (0..samples).map(|sample| self.sunlight(point, normal, sample)).sum::<f64>() / samples as f64;
        self.diffuse(&Hit { point, normal, solid: *solid }, albedo, sunlight).to_array().map(srgb8)
    }

    /// Whether a point is visible from the eye.
    pub(super) fn is_visible(&self, point: DVec3, eye: DVec3) -> bool {
        let away = eye - point;
        let distance = away.length();
        let ray = Ray { origin: point, direction: away / distance };
        !self.is_blocked(&ray, distance)
    }

    fn diffuse(&self, hit: &Hit, albedo: DVec3, sunlight: f64) -> DVec3 {
        let up = 0.5 + 0.5 * hit.normal.z;
        let ambient = GROUND_LIGHT + (SKY_LIGHT - GROUND_LIGHT) * up;
        let facing = hit.normal.dot(self.sun).max(0.0);
        albedo * (ambient * self.sky_visibility(hit.point, hit.normal) + SUN_COLOR * (sunlight * facing))
    }

    /// Share of the sun that reaches a point.
    fn sunlight(&self, point: DVec3, normal: DVec3, sample: usize) -> f64 {
        if normal.dot(self.sun) <= 0.0 {
            return 0.0;
        }
        let side = self.sun.any_orthonormal_vector();
        let other = self.sun.cross(side);
        let origin = point + normal * 1e-4;
        let reached = (0..SHADOW_RAYS)
            .filter(|index| {
                // A spiral of golden-angle turns covers the sun's disc evenly with any number of rays.
                let order = f64::from(*index) + (sample as f64 + 0.5) / SUBPIXELS.len() as f64;
                let radius = SUN_SPREAD * (order / f64::from(SHADOW_RAYS)).sqrt();
                let turn = 2.399_963_229_728_653 * (f64::from(*index) * 4.0 + sample as f64);
                let direction = self.sun + side * (radius * cos(turn)) + other * (radius * sin(turn));
                !self.is_blocked(&Ray { origin, direction: direction.normalize() }, f64::INFINITY)
            })
            .count();
        reached as f64 / f64::from(SHADOW_RAYS)
    }

    /// Share of the sky that is visible from a point, with each solid taken as a ball: ambient occlusion without the noise of
    /// random rays.
    fn sky_visibility(&self, point: DVec3, normal: DVec3) -> f64 {
        self.solids[..self.fence_from].iter().filter_map(|solid| solid.shape.bound()).fold(
            1.0,
            |open, (center, radius)| {
                let to = center - point;
                let distance = to.length();
                let share = (radius / distance).min(1.0);
                let cover = 0.7 * share * share;
                open * (1.0 - cover * (normal.dot(to) / distance).max(0.0))
            },
        )
    }

    fn hit(&self, ray: &Ray) -> Option<Hit> {
        let mut nearest: Option<(f64, &Solid)> = None;
        for solid in self.candidates(ray) {
            if let Some(distance) = solid.shape.intersect(ray)
                && nearest.is_none_or(|(best, _)| distance < best)
            {
                nearest = Some((distance, solid));
            }
        }
        let (distance, solid) = nearest?;
        let point = ray.at(distance);
        Some(Hit { point, normal: solid.shape.normal(point), solid: *solid })
    }

    fn is_blocked(&self, ray: &Ray, before: f64) -> bool {
        self.candidates(ray)
            .filter(|solid| solid.shape.bound().is_some())
            .any(|solid| solid.shape.intersect(ray).is_some_and(|distance| distance < before - 1e-3))
    }

    /// The solids whose bounds the ray meets.
    fn candidates(&self, ray: &Ray) -> impl Iterator<Item = &Solid> {
        let passes = |(center, radius): (DVec3, f64)| {
            ball(ray, center, radius).is_some_and(|(_, far)| far > MIN_DISTANCE)
        };
        let end = if passes(self.fence) { self.solids.len() } else { self.fence_from };
        self.solids[..end].iter().filter(move |solid| solid.shape.bound().is_none_or(passes))
    }
}

/// The fence: posts, two rails, and crossed wires thinner than a pixel in most views, around one corner.
fn fence() -> Vec<(DVec3, DVec3, f64)> {
    const POST: f64 = 0.022;
    const WIRE: f64 = 0.009;
    const FIELDS: usize = 6;
    let (start, corner, end) =
        (DVec3::new(-0.2, 1.5, 0.0), DVec3::new(1.35, 1.5, 0.0), DVec3::new(1.35, 0.15, 0.0));
    let mut rods = Vec::new();
    for (from, to) in [(start, corner), (corner, end)] {
        let at = |index: usize| from + (to - from) * (index as f64 / FIELDS as f64);
        let (low, high) = (DVec3::Z * 0.12, DVec3::Z * 0.72);
        for index in 0..FIELDS {
            let (left, right) = (at(index), at(index + 1));
            rods.push((left, left + DVec3::Z * 0.82, POST));
            rods.push((left + low, right + high, WIRE));
            rods.push((left + high, right + low, WIRE));
        }
        rods.push((from + low, to + low, WIRE * 1.4));
        rods.push((from + high, to + high, WIRE * 1.4));
    }
    rods.push((end, end + DVec3::Z * 0.82, POST));
    rods
}

/// A ball that holds all of `solids`.
fn bound_of(solids: &[Solid]) -> (DVec3, f64) {
    let balls: Vec<_> = solids.iter().filter_map(|solid| solid.shape.bound()).collect();
    let center = balls.iter().map(|(center, _)| *center).sum::<DVec3>() / balls.len() as f64;
    let radius = balls.iter().map(|(at, radius)| at.distance(center) + radius).fold(0.0, f64::max);
    (center, radius)
}

/// The ray from the camera's center through a point of its image plane, in pixels.
fn ray_through(camera: &Camera, at: DVec2) -> Ray {
    let k = &camera.intrinsics;
    let local = DVec3::new((at.x - k.cx) / k.fx, (at.y - k.cy) / k.fy, 1.0);
    let direction = (camera.pose.rotation().transpose() * local).normalize();
    Ray { origin: camera.pose.center(), direction }
}

/// Linear light to an 8-bit sRGB value.
fn srgb8(linear: f64) -> u8 {
    let x = linear.clamp(0.0, 1.0);
    let encoded = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * pow(x, 1.0 / 2.4) - 0.055 };
    (encoded * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        domain::{Digest, Intrinsics, Pose},
        sample::{Settings, views},
    };

    fn camera_at(position: DVec3, target: DVec3) -> Camera {
        let pose = Pose::look_at(position, target, DVec3::Z).expect("a view");
        let intrinsics = Intrinsics { fx: 120.0, fy: 120.0, cx: 24.0, cy: 24.0, width: 48, height: 48 };
        Camera::new(intrinsics, pose).expect("a camera")
    }

    #[test]
    fn a_known_point_has_its_color_where_the_camera_projects_it() {
        let scene = Scene::still_life();
        // The middle of a patch on the top of the block, seen from three sides.
        let block = scene
            .solids
            .iter()
            .find(|solid| matches!(solid.shape, SampleShape::Block { .. }))
            .expect("a block");
        let (turn, side) = (0.5_f64, 0.07);
        let point =
            DVec3::new(0.7 + side * (cos(turn) - sin(turn)), -0.3 + side * (cos(turn) + sin(turn)), 0.7);
        let expected = scene.matt_color(block, point);
        for position in [DVec3::new(3.0, -1.0, 2.5), DVec3::new(-1.5, -3.0, 2.0), DVec3::new(0.5, 2.0, 3.0)] {
            let camera = camera_at(position, point - DVec3::Z * 0.1);
            let (at, _) = camera.project(point).expect("in front");
            let image = scene.render(&camera);
            let first = (at.y as usize * 48 + at.x as usize) * 3;
            for (seen, wanted) in image.samples()[first..first + 3].iter().zip(expected) {
                assert!(seen.abs_diff(wanted) < 20, "{seen}, not {wanted}, from {position}");
            }
        }
    }

    #[test]
    fn the_sun_is_above_everything_and_the_ball_casts_a_shadow() {
        let scene = Scene::still_life();
        let center = DVec3::new(-0.55, -0.55, 0.5);
        let shadowed = center - scene.sun * (center.z / scene.sun.z);
        assert_eq!(scene.sunlight(shadowed, DVec3::Z, 0), 0.0);
        assert_eq!(scene.sunlight(DVec3::new(0.0, -1.6, 0.0), DVec3::Z, 0), 1.0);
    }

    #[test]
    fn bounds_do_not_change_what_is_seen() {
        let scene = Scene::still_life();
        let mut unbounded = Scene::still_life();
        unbounded.fence.1 = f64::MAX.sqrt();
        let camera = camera_at(DVec3::new(2.0, 3.0, 1.0), DVec3::new(1.0, 1.0, 0.4));
        assert_eq!(scene.render(&camera), unbounded.render(&camera));
    }

    #[test]
    fn the_same_pixels_are_rendered_on_every_machine() {
        let camera = views::cameras(&Settings::square(32))[5];
        let image = Scene::still_life().render(&camera);
        assert_eq!(image, Scene::still_life().render(&camera));
        assert_eq!(
            Digest::of(image.samples()).to_string(),
            "8aa3718e70a53fb1958b67a477c90dfb6090b671bc18414af0f07953c30b96ae",
            "if the scene was changed on purpose, write the new digest here"
        );
    }
}
