// From a Gaussian in the world to a splat on the screen. ops/reference.py states the same formulas.
#pragma once
#include <cmath>
#include <limits>

#include "harmonics.hpp"
#include "workspace.hpp"

namespace SPLAT_VARIANT {

constexpr double BOX_MARGIN = 0.01;               // pixels; rounding must never cull a touched pixel
constexpr double COMPENSATION_FLOOR = 2.5e-5;     // least det / det_blurred of the antialias compensation
constexpr double DETERMINANT_MIN = 1e-12;         // px^4; only without blur: thinner splats touch no pixel centre
constexpr double LOG2_SCALE = 0.84932180028801907;  // sqrt(log2(e) / 2)
constexpr double TWO_LN2 = 1.3862943611198906;

template <class T>
struct Camera {
  Matrix<T> rotation;
  Vector<T> translation;
  T fx, fy, cx, cy, slope_min[2], slope_max[2];
  T alpha_min, blur, near_plane, width, height;
  bool antialias;

  explicit Camera(const View& v)
      : fx(v.fx), fy(v.fy), cx(v.cx), cy(v.cy), alpha_min(v.alpha_min), blur(v.blur), near_plane(v.near_plane),
        width(v.width), height(v.height), antialias(v.antialias) {
    for (int i = 0; i < 3; ++i)
      rotation.rows[i] = {T(v.rotation[3 * i]), T(v.rotation[3 * i + 1]), T(v.rotation[3 * i + 2])};
    translation = {T(v.translation[0]), T(v.translation[1]), T(v.translation[2])};
    const T margin_x = T(0.3) * width / (2 * fx), margin_y = T(0.3) * height / (2 * fy);
    slope_min[0] = -cx / fx - margin_x, slope_max[0] = (width - cx) / fx + margin_x;
    slope_min[1] = -cy / fy - margin_y, slope_max[1] = (height - cy) / fy + margin_y;
  }
};

template <class T>
inline T limited(T value, T low, T high) { return value < low ? low : (value > high ? high : value); }

// Everything between the parameters of one row and its splat that backward needs again.
template <class T>
struct Projection {
  Vector<T> in_camera;
  T inverse_z, slope[2];
  bool inside[2];          // the slope was not limited
  T quaternion[4], length;  // unit; length 0: a zero quaternion, replaced by the identity
  Matrix<T> world_from_gaussian, camera_from_gaussian;  // rotation; rotation times scales
  Vector<T> factor_x, factor_y;                         // rows of V = J R S
  T variance_x, variance_y, covariance, determinant, bare_determinant;
};

template <class T>
inline void rotation_from_quaternion(const T* given, Projection<T>& p) {
  const T squared = given[0] * given[0] + given[1] * given[1] + given[2] * given[2] + given[3] * given[3];
  const bool usable = squared > std::numeric_limits<T>::min();
  p.length = usable ? std::sqrt(squared) : T(0);
  const T inverse = usable ? 1 / p.length : T(0);
  for (int i = 0; i < 4; ++i) p.quaternion[i] = usable ? given[i] * inverse : T(i == 0);
  const T w = p.quaternion[0], x = p.quaternion[1], y = p.quaternion[2], z = p.quaternion[3];
  p.world_from_gaussian = {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                            {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                            {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}

// The row's covariance on the screen; p.in_camera must be set and lie in front of the camera.
template <class T>
inline void project_shape(const Camera<T>& camera, const T* quaternion, const T* scales, Projection<T>& p) {
  rotation_from_quaternion(quaternion, p);
  Matrix<T> axes = p.world_from_gaussian;
  for (auto& row : axes.rows) row = {row.x * scales[0], row.y * scales[1], row.z * scales[2]};
  p.camera_from_gaussian = camera.rotation * axes;
  p.inverse_z = 1 / p.in_camera.z;
  const T slopes[2] = {p.in_camera.x * p.inverse_z, p.in_camera.y * p.inverse_z};
  for (int axis = 0; axis < 2; ++axis) {
    p.slope[axis] = limited(slopes[axis], camera.slope_min[axis], camera.slope_max[axis]);
    p.inside[axis] = p.slope[axis] == slopes[axis];
  }
  const Matrix<T>& m = p.camera_from_gaussian;
  p.factor_x = (camera.fx * p.inverse_z) * (m.rows[0] + -p.slope[0] * m.rows[2]);
  p.factor_y = (camera.fy * p.inverse_z) * (m.rows[1] + -p.slope[1] * m.rows[2]);
  const T xx = dot(p.factor_x, p.factor_x), yy = dot(p.factor_y, p.factor_y);
  const Vector<T> c = cross(p.factor_x, p.factor_y);
  // Cauchy-Binet: a sum of squares, so needles lose no digits and the determinant is never negative.
  p.bare_determinant = dot(c, c);
  p.determinant = p.bare_determinant + camera.blur * (xx + yy) + camera.blur * camera.blur;
  p.variance_x = xx + camera.blur, p.variance_y = yy + camera.blur, p.covariance = dot(p.factor_x, p.factor_y);
}

template <class T>
inline T compensation(const Camera<T>& camera, const Projection<T>& p) {
  if (!camera.antialias) return T(1);
  const T ratio = p.bare_determinant / p.determinant;
  return std::sqrt(ratio > T(COMPENSATION_FLOOR) ? ratio : T(COMPENSATION_FLOOR));
}

// Colour before the clamp at zero; also the unit direction, the distance and the basis for backward.
template <class T>
struct ViewColor {
  Vector<T> direction, raw;
  T distance;
  T values[16];
};

template <class T>
inline ViewColor<T> view_color(const Camera<T>& camera, const Vector<T>& in_camera, const T* sh, int64_t terms) {
  ViewColor<T> c;
  const Vector<T> ray = transposed(camera.rotation, in_camera);
  c.distance = std::sqrt(dot(ray, ray));
  c.direction = (1 / c.distance) * ray;
  basis(c.direction, terms, c.values);
  c.raw = {T(0.5), T(0.5), T(0.5)};
  for (int64_t k = 0; k < terms; ++k) {
    c.raw.x += c.values[k] * sh[3 * k], c.raw.y += c.values[k] * sh[3 * k + 1], c.raw.z += c.values[k] * sh[3 * k + 2];
  }
  return c;
}

// First and last index whose pixel centre lies within [centre - half, centre + half], cut to [0, size); as T first,
// since the box of a giant does not fit an integer.
template <class T>
inline void pixel_span(T centre, T half, T size, int32_t& first, int32_t& last) {
  first = int32_t(limited(std::ceil(centre - half - T(0.5)), T(0), size));
  last = int32_t(limited(std::floor(centre + half - T(0.5)), T(-1), size - 1));
}

// Fills `out` and answers true if the row can touch a pixel. Comparisons are written so that NaN culls.
template <class T>
inline bool project_row(const Camera<T>& camera, const T* mean, const T* quaternion, const T* scales, T opacity,
                        const T* sh, int64_t terms, Splat<T>& out) {
  Projection<T> p;
  p.in_camera = camera.rotation * Vector<T>{mean[0], mean[1], mean[2]} + camera.translation;
  if (!(p.in_camera.z > camera.near_plane && opacity > 0)) return false;
  project_shape(camera, quaternion, scales, p);
  if (!(p.determinant >= T(DETERMINANT_MIN) && p.determinant <= std::numeric_limits<T>::max())) return false;
  const T effective = opacity * compensation(camera, p);
  if (!(effective >= camera.alpha_min)) return false;
  out.x = camera.fx * p.in_camera.x * p.inverse_z + camera.cx;
  out.y = camera.fy * p.in_camera.y * p.inverse_z + camera.cy;
  if (camera.alpha_min > 0) {
    const T reach = 2 * std::log(effective / camera.alpha_min);
    const T safe = reach > 0 ? reach : T(0);
    out.half_x = std::sqrt(safe * p.variance_x), out.half_y = std::sqrt(safe * p.variance_y);
  } else {
    out.half_x = out.half_y = std::numeric_limits<T>::infinity();
  }
  const T box_x = out.half_x + T(BOX_MARGIN), box_y = out.half_y + T(BOX_MARGIN);
  if (!(out.x + box_x >= T(0.5) && out.x - box_x <= camera.width - T(0.5))) return false;
  if (!(out.y + box_y >= T(0.5) && out.y - box_y <= camera.height - T(0.5))) return false;
  pixel_span(out.y, box_y + T(1e-5) * out.half_y, camera.height, out.first_row, out.last_row);
  const T scale = T(LOG2_SCALE);
  out.l11 = scale * std::sqrt(p.variance_y / p.determinant);
  out.l21 = -scale * p.covariance / (std::sqrt(p.variance_y) * std::sqrt(p.determinant));
  out.l22 = scale / std::sqrt(p.variance_y);
  out.log2_opacity = std::log2(effective);
  const ViewColor<T> c = view_color(camera, p.in_camera, sh, terms);
  out.color[0] = c.raw.x > 0 ? c.raw.x : T(0);
  out.color[1] = c.raw.y > 0 ? c.raw.y : T(0);
  out.color[2] = c.raw.z > 0 ? c.raw.z : T(0);
  out.depth = p.in_camera.z;
  return true;
}

}  // namespace SPLAT_VARIANT
