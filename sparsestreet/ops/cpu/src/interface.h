// The plain C interface of the splat library; cpu/library.py mirrors these structs. All arrays are row-major.
#pragma once
#include <cstdint>

namespace splat {

constexpr int32_t INTERFACE_VERSION = 19;

// Side of the square tiles, pixels: the build's SPARSESTREET_TILE (CMakeLists.txt).
constexpr int TILE = SPLAT_TILE;

enum Status : int32_t { OK = 0, BAD_VALUE = 1, TOO_MANY_PAIRS = 2, OUT_OF_MEMORY = 3 };

// A camera and the settings of one rendering.
struct View {
  double rotation[9];     // camera from world
  double position[3];     // of the camera in the world, meters
  double fx, fy, cx, cy;  // pixels
  double alpha_min, alpha_max, transmittance_min, eps2d, near_plane;
  double max_sigma;       // standard deviations at which a splat ends
  double distortion[5];   // k1, k2, p1, p2, k3
  double fold;            // r^2 past which the lens does not see
  double shutter_translation[3], shutter_rotation[3];  // over the readout, camera frame
  int64_t width, height;
  int64_t exclusive_stop, antialias, half_colors, clamp_colors, detach_directions, plain_gradients, depth_bits;
  int64_t has_lens, has_shutter;
  int64_t shutter_columns;  // read one after the other, instead of rows
  int64_t shutter_sign;     // -1 if the readout runs towards smaller coordinates, else 1
  int64_t every_tile;  // lists each splat in every tile and looks at all their pixels: to check lists and masks against
  int64_t pair_limit;  // (splat, tile) pairs that may be held
  int64_t threads;
};

// Spherical harmonics of rows that follow each other, and where their gradients go. `rest` are the coefficients behind
// the first; of a table that holds both, it is three numbers further. Strides are numbers between rows.
struct Harmonics {
  int64_t rows, terms;   // terms: coefficients in use
  int64_t stored_rest;   // coefficients of `rest`, also those not in use, whose gradients are 0
  int64_t first_stride, rest_stride;
  const void *first, *rest;
  void *v_first, *v_rest;  // of backward; v_rest null: not asked for
};

// Activated Gaussians; pointers to float or double.
struct Rows {
  int64_t count, tables;
  const Harmonics* harmonics;  // [tables], of all rows in order
  const void *means, *quaternions, *scales, *opacities;
  const void* displacements;  // null: none
  const void* gates;          // factors of alpha in every pixel, null: 1
};

// Layers of an image: premultiplied color [h,w,3], transmittance [h,w], sum of weighted depths [h,w].
struct Layers {
  void *rgb, *transmittance, *depth_sum;
};

// Gradients of the rows but those of harmonics; screen: sum over pixels of |dLoss / d mean on the screen|, of plain_gradients without the bars,
// [n,2]; gates: null if the rows have none.
struct RowGradients {
  void *means, *quaternions, *scales, *opacities, *screen, *gates;
};

struct Counters {
  double* weight;
  int64_t *pixels, *dominant;
};

// What finished each pixel [h,w]: a row and its depth.
struct Finishers {
  int64_t* rows;
  void* depth;
};

// In how many ways squared changes can be counted at once.
constexpr int COUNTINGS = 3;

// Behind the splats [h,w,3], null: black; how much each pixel's squared change counts [ways,h,w], null: 1.
struct Backdrop {
  const void *rgb, *pixel_weights;
};

// How far a view moves when a row alone is removed: largest and squared changes [n] and [n,ways]; sums of blend weights.
struct Changes {
  double *largest, *squared, *weight;
};

// A cube map behind an image, and the camera that sees it; pointers to float or double.
struct Sky {
  double rays[9];  // a place (x, y, 1) in the image, pixels, to its direction in the world
  double transmittance_min;
  int64_t width, height, side, threads;
  const int64_t* bordered;  // the texel of each entry of the faces with a border [6,side+2,side+2]
  const void* texels;       // [6,side,side,3]
  const void* directions;   // of the pixels in the world [h,w,3]; null: those of `rays`
};

constexpr int SSIM_WINDOW = 11;

// Two images [h,w,3] whose structural similarity is asked for, and its definition.
struct ImagePair {
  const void *image, *truth;
  int64_t height, width;
  double taps[SSIM_WINDOW];  // along one axis, symmetric
  double c1, c2;
  int64_t threads;
};

// What went wrong, for the message: pair total and the three rows with most pairs (row -1: none).
struct Report {
  int64_t pairs;
  int64_t worst_rows[3], worst_pairs[3];
};

// Rows as a node stores them, without harmonics; null: multipliers (1), instances (no poses).
struct RawRows {
  int64_t count;
  double logit_limit;
  const void *means, *log_scales, *quaternions, *opacity_logits, *multipliers;
  const int64_t* instances;  // of the rows
  int64_t num_instances;
  const void *pose_quaternions, *pose_translations;
  const uint8_t* present;
  int64_t threads;
};

// Activated rows or their gradients.
struct ActiveRows {
  void *means, *quaternions, *scales, *opacities;
};

// Null: what is not asked for.
struct RawGradients {
  void *means, *log_scales, *quaternions, *opacity_logits, *multipliers;
  void *pose_quaternions, *pose_translations;
};

// Tables [instances, length] of keyframes, those that are valid first.
struct Keyframes {
  int64_t instances, length;
  const void *times, *quaternions, *translations;
  const uint8_t* valid;
  const void *spans, *rotation_deltas, *translation_deltas;
  double time, max_gap, tolerance;
};

// Poses at a time, and what their gradient needs: derivatives of the quaternion [instances, 4, 6], the fraction, and the
// two keyframes as rows of the flattened tables.
struct InstancePoses {
  void *quaternions, *translations;
  uint8_t* present;
  double *slopes, *fractions;
  int64_t* keyframes;
};

// A parameter of `rows` rows of `width` numbers, its gradient and moments, and the numbers of a step.
struct AdamRows {
  int64_t rows, width;
  void* parameter;
  const void* gradient;
  void *exp_avg, *exp_avg_sq;
  double share, beta, square_share, root, eps, size;
  int64_t* refused;  // number of rows whose gradient is not finite, and the first of them
};

// What a view shows of each row: [rows, 2] gradients per pixel, and radii; half the sides of the image, and the longer.
struct ScreenView {
  int64_t rows;
  const void *gradient, *radii;
  double half_width, half_height, longer;
  int64_t visits_all, threads;
};

// Sums over views that take it in. Null: the three that all nodes have, or the watched column.
struct RowStatistics {
  void* gradient_sum;
  int64_t* visits;
  void *largest_screen, *watched_sum;
  const void* watched;
};

// Kinds of losses that are a mean over pixels, and their numbers: of depths the nearest and farthest return and the
// nearest rendered depth, of a sky epsilon and the floor.
enum PixelKind { DEPTH, INVERSE_DEPTH, SKY };

struct PixelTerm {
  int64_t kind, pixels;
  double numbers[3], weight;
  int64_t threads;
};

// An image and a recorded one of 8 bits; from level `white` on a larger number counts as equal. Errors are summed times
// `scale`.
struct Colors {
  const void* image;
  const uint8_t* recorded;
  int64_t numbers, white;
  double scale;
  int64_t threads;
};

enum Stage { PROJECT, BIN, BLEND, BLEND_BACKWARD, PROJECT_BACKWARD, COUNT, STAGES };

}  // namespace splat
