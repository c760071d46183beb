//! Renders frames on the calling thread while rayon's threads process the views that are rendered already.
//!
//! Invariants: results come in the order of the frames; views in flight have at most [`MAX_VIEWS`] views and [`MAX_PIXELS`] pixels in
//! all, or are one view and the one being rendered.

use std::{
    collections::VecDeque,
    sync::mpsc::{self, Receiver, TryRecvError},
    thread,
};

use crate::domain::{Frame, Image};

/// Views that are rendered and not yet processed, at most.
const MAX_VIEWS: u64 = 8;
/// Their pixels, if there are several.
const MAX_PIXELS: u64 = 1 << 22;

/// Host bytes a pixel of a view that is scored: render, photograph over its background, and one value of SSIM.
const BYTES_A_PIXEL: u64 = 3 + 3 + 8;
/// Host bytes a pixel of the view that is rendered meanwhile.
const RENDERED_BYTES_A_PIXEL: u64 = 3;

/// Peak host bytes of measuring PSNR and SSIM of views of at most `pixels`, beside photographs that are in memory anyway.
#[must_use]
pub fn measuring_bytes(pixels: u64) -> u64 {
    let views = (MAX_PIXELS / pixels.max(1)).clamp(1, MAX_VIEWS);
    (views * BYTES_A_PIXEL + RENDERED_BYTES_A_PIXEL) * pixels
}

/// How many views may be in flight.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InFlight {
    /// As many as the module's bounds allow.
    Several,
    /// One, for processing that takes much memory and all cores.
    One,
}

impl InFlight {
    /// Whether `more` pixels may be rendered beside the views in flight.
    fn has_room(self, pixels: impl ExactSizeIterator<Item = u64>, more: u64) -> bool {
        let views = pixels.len() as u64;
        match self {
            _ if views == 0 => true,
            Self::One => false,
            Self::Several => views < MAX_VIEWS && pixels.sum::<u64>() + more <= MAX_PIXELS,
        }
    }
}

/// What to do with each view.
pub struct ViewTasks<'a, T, E> {
    /// Renders a frame, on the calling thread.
    pub render: &'a mut dyn FnMut(&Frame) -> Result<Image, E>,
    /// Processes a rendered view, on one of rayon's threads.
    pub process: &'a (dyn Fn(&Frame, Image) -> Result<T, E> + Sync),
    /// Takes the result, on the calling thread and in the order of the frames.
    pub collect: &'a mut dyn FnMut(T) -> Result<(), E>,
}

/// Renders all frames; each is processed while the next ones are rendered.
///
/// # Errors
/// The first error of a task in the order of the frames. Views in flight are processed before it returns.
pub fn for_each_view<T: Send, E: Send>(
    frames: &[&Frame],
    in_flight: InFlight,
    tasks: ViewTasks<'_, T, E>,
) -> Result<(), E> {
    let ViewTasks { render, process, collect } = tasks;
    rayon::in_place_scope(|scope| {
        let mut views: VecDeque<(u64, Receiver<Result<T, E>>)> = VecDeque::new();
        for frame in frames {
            let pixels = u64::from(frame.image.width()) * u64::from(frame.image.height());
            while !in_flight.has_room(views.iter().map(|view| view.0), pixels) {
                collect_first(&mut views, collect)?;
            }
            let image = render(frame)?;
            let (sender, receiver) = mpsc::sync_channel(1);
            views.push_back((pixels, receiver));
            scope.spawn(move |_| {
                // Nobody receives it after another view's error.
                let _ = sender.send(process(frame, image));
            });
        }
        while !views.is_empty() {
            collect_first(&mut views, collect)?;
        }
        Ok(())
    })
}

fn collect_first<T, E>(
    views: &mut VecDeque<(u64, Receiver<Result<T, E>>)>,
    collect: &mut dyn FnMut(T) -> Result<(), E>,
) -> Result<(), E> {
    let result = views.pop_front().and_then(|(_, receiver)| wait(&receiver));
    // A task that panics sends nothing; the scope passes its panic on.
    result.map_or(Ok(()), |result| collect(result?))
}

/// The message; `None` if its sender is gone.
fn wait<T>(receiver: &Receiver<T>) -> Option<T> {
    if rayon::current_thread_index().is_none() {
        return receiver.recv().ok();
    }
    // One of rayon's threads must not block, since the task may be in its own queue.
    loop {
        match receiver.try_recv() {
            Ok(message) => return Some(message),
            Err(TryRecvError::Disconnected) => return None,
            Err(TryRecvError::Empty) => match rayon::yield_now() {
                Some(rayon::Yield::Executed) => {}
                _ => thread::yield_now(),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    };

    use super::*;
    use crate::domain::{Camera, Intrinsics, Pose, Split};

    fn frames(count: usize, side: u32) -> Vec<Frame> {
        let frame = |index: usize| {
            let pose = Pose::look_at(glam::DVec3::X, glam::DVec3::ZERO, glam::DVec3::Z).expect("a view");
            let intrinsics = Intrinsics::from_horizontal_fov(1.0, side, side).expect("intrinsics");
            Frame {
                name: index.to_string(),
                camera: Camera::new(intrinsics, pose).expect("a camera"),
                image: image(side).into(),
                mask: None,
                split: Split::Test,
            }
        };
        (0..count).map(frame).collect()
    }

    fn image(side: u32) -> Image {
        Image::new(side, side, 3, vec![0; 3 * (side * side) as usize]).expect("an image")
    }

    fn number(frame: &Frame) -> usize {
        frame.name.parse().expect("a number")
    }

    /// The names in the order of their results, and the most views that were in flight.
    fn run(side: u32, in_flight: InFlight, fails: Option<usize>) -> (Result<(), usize>, Vec<usize>, usize) {
        let (frames, now, max) = (frames(30, side), AtomicUsize::new(0), Mutex::new(0));
        let frames: Vec<&Frame> = frames.iter().collect();
        let mut collected = Vec::new();
        let tasks = ViewTasks {
            render: &mut |_| {
                let views = now.fetch_add(1, Ordering::SeqCst) + 1;
                let mut max = max.lock().expect("not poisoned");
                *max = views.max(*max);
                Ok(image(side))
            },
            process: &|frame, _| match number(frame) {
                number if fails.is_some_and(|first| number >= first) => Err(number),
                number => Ok(number),
            },
            collect: &mut |number| {
                now.fetch_sub(1, Ordering::SeqCst);
                collected.push(number);
                Ok(())
            },
        };
        let result = for_each_view(&frames, in_flight, tasks);
        let max = *max.lock().expect("not poisoned");
        (result, collected, max)
    }

    #[test]
    fn results_come_in_order_and_views_in_flight_are_bounded() {
        for (side, in_flight, bound) in
            [(2, InFlight::Several, MAX_VIEWS as usize), (2, InFlight::One, 1), (1024, InFlight::Several, 4)]
        {
            let (result, collected, max) = run(side, in_flight, None);
            assert_eq!((result, collected), (Ok(()), (0..30).collect()));
            assert!(max <= bound + 1, "{max} views of {side} pixels per side");
        }
    }

    #[test]
    fn the_first_error_in_the_order_of_the_frames_ends_it() {
        let (result, collected, _) = run(2, InFlight::Several, Some(7));
        assert_eq!((result, collected), (Err(7), (0..7).collect()));
    }

    #[test]
    fn a_pool_of_one_thread_waits_for_its_own_tasks() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool");
        let (result, collected, _) = pool.install(|| run(2, InFlight::Several, None));
        assert_eq!((result, collected.len()), (Ok(()), 30));
    }

    #[test]
    fn the_bytes_are_those_of_the_views_in_flight() {
        assert_eq!(measuring_bytes(100), (8 * 14 + 3) * 100);
        assert_eq!(measuring_bytes(800 * 800), (6 * 14 + 3) * 640_000);
        assert_eq!(measuring_bytes(10_000_000), 17 * 10_000_000);
    }
}
