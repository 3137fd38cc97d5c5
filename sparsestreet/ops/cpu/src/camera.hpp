// The camera and the settings of a view in the precision of the rows.
#pragma once
#include <cmath>
#include <limits>

#include "interface.h"
#include "small_matrix.hpp"
#include "values.hpp"

namespace SPLAT_VARIANT {

using namespace splat;

constexpr double LEAST_EXPONENT = -126;  // without a cut-off alpha still ends where float does: 2^-126

template <class T>
struct Camera {
  Matrix<T> rotation;
  Vector<T> position, position_rest;  // their sum: in the world, with twice the digits of T
  T fx, fy, cx, cy, slope_min[2], slope_max[2];
  T k1, k2, p1, p2, k3, fold;  // Brown-Conrady; fold: the r^2 at which the radial polynomial turns back
  Vector<T> shutter_translation, shutter_rotation;
  T alpha_min, log2_alpha_min, eps2d, near_plane, width, height;
  T max_sigma_squared;  // the largest |L d|^2 that is drawn
  bool antialias, half_colors, clamp_colors, detach_directions, plain_gradients, every_tile;
  int depth_bits;
  T motion_fx, motion_fy;  // fx, fy, negative if the readout runs towards smaller coordinates

  explicit Camera(const View& v)
      : position(vector(v.position)), position_rest(rest(v.position)), fx(v.fx), fy(v.fy), cx(v.cx), cy(v.cy),
        k1(v.distortion[0]), k2(v.distortion[1]), p1(v.distortion[2]), p2(v.distortion[3]), k3(v.distortion[4]),
        fold(v.fold),
        shutter_translation(vector(v.shutter_translation)), shutter_rotation(vector(v.shutter_rotation)),
        alpha_min(v.alpha_min), log2_alpha_min(std::fmax(std::log2(v.alpha_min), LEAST_EXPONENT)), eps2d(v.eps2d),
        near_plane(v.near_plane), width(v.width), height(v.height), max_sigma_squared(T(v.max_sigma) * T(v.max_sigma)),
        antialias(v.antialias), half_colors(v.half_colors), clamp_colors(v.clamp_colors),
        detach_directions(v.detach_directions), plain_gradients(v.plain_gradients), every_tile(v.every_tile),
        depth_bits(int(v.depth_bits)), motion_fx(v.shutter_sign * v.fx), motion_fy(v.shutter_sign * v.fy) {
    for (int i = 0; i < 3; ++i) rotation.rows[i] = vector(v.rotation + 3 * i);
    const T margin_x = T(0.3) * width / (2 * fx), margin_y = T(0.3) * height / (2 * fy);
    slope_min[0] = -cx / fx - margin_x, slope_max[0] = (width - cx) / fx + margin_x;
    slope_min[1] = -cy / fy - margin_y, slope_max[1] = (height - cy) / fy + margin_y;
  }
  // Whether boxes and lists of tiles end where splats do.
  bool bounded() const {
    return !every_tile && (alpha_min > 0 || max_sigma_squared <= std::numeric_limits<T>::max());
  }

 private:
  static Vector<T> vector(const double* v) { return {T(v[0]), T(v[1]), T(v[2])}; }
  static Vector<T> rest(const double* v) { return {T(v[0] - T(v[0])), T(v[1] - T(v[1])), T(v[2] - T(v[2]))}; }
};

}  // namespace SPLAT_VARIANT
