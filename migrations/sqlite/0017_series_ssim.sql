-- The training views' SSIM beside their PSNR; null in points of earlier versions.
ALTER TABLE series ADD COLUMN ssim REAL;
