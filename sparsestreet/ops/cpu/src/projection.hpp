// From a Gaussian in the world to a splat on the screen. ops/reference.py states the same formulas. V is a register of
// rows: nothing branches, a row that is culled is computed all the same and its lane of the mask is 0.
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
constexpr double LEAST_EXPONENT = -126;  // without a cut-off alpha still ends where float does: 2^-126

template <class T>
struct Camera {
  Matrix<T> rotation;
  Vector<T> translation;
  T fx, fy, cx, cy, slope_min[2], slope_max[2];
  T alpha_min, log2_alpha_min, blur, near_plane, width, height;
  bool antialias;

  explicit Camera(const View& v)
      : fx(v.fx), fy(v.fy), cx(v.cx), cy(v.cy), alpha_min(v.alpha_min),
        log2_alpha_min(std::fmax(std::log2(v.alpha_min), LEAST_EXPONENT)), blur(v.blur), near_plane(v.near_plane),
        width(v.width), height(v.height), antialias(v.antialias) {
    for (int i = 0; i < 3; ++i)
      rotation.rows[i] = {T(v.rotation[3 * i]), T(v.rotation[3 * i + 1]), T(v.rotation[3 * i + 2])};
    translation = {T(v.translation[0]), T(v.translation[1]), T(v.translation[2])};
    const T margin_x = T(0.3) * width / (2 * fx), margin_y = T(0.3) * height / (2 * fy);
    slope_min[0] = -cx / fx - margin_x, slope_max[0] = (width - cx) / fx + margin_x;
    slope_min[1] = -cy / fy - margin_y, slope_max[1] = (height - cy) / fy + margin_y;
  }
};

// The parameters of a row that do not depend on the view.
template <class V>
struct RowValues {
  Vector<V> mean, scales;
  V quaternion[4], opacity;
};

// Everything between the parameters of a row and its splat that backward needs again.
template <class V>
struct Projection {
  Vector<V> in_camera;
  V inverse_z, slope[2];
  Index<V> inside[2];       // the slope was not limited
  V quaternion[4], length;  // unit; length 0: a zero quaternion, replaced by the identity
  Matrix<V> world_from_gaussian, camera_from_gaussian;  // rotation; rotation times scales
  Vector<V> factor_x, factor_y;                         // rows of V = J R S
  V variance_x, variance_y, covariance, determinant, bare_determinant;
};

template <class V>
inline void rotation_from_quaternion(const V* given, Projection<V>& p) {
  const V squared = given[0] * given[0] + given[1] * given[1] + given[2] * given[2] + given[3] * given[3];
  const auto usable = squared > std::numeric_limits<Scalar<V>>::min();
  p.length = usable ? root(squared) : V{};
  const V inverse = 1 / p.length;
  for (int i = 0; i < 4; ++i) p.quaternion[i] = usable ? given[i] * inverse : V{} + Scalar<V>(i == 0);
  const V w = p.quaternion[0], x = p.quaternion[1], y = p.quaternion[2], z = p.quaternion[3];
  p.world_from_gaussian = {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                            {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                            {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}

// The axes of the Gaussian in the camera, and where its mean lies.
template <class T, class V>
inline void place(const Camera<T>& camera, const RowValues<V>& row, Projection<V>& p) {
  p.in_camera = camera.rotation * row.mean;
  p.in_camera = {p.in_camera.x + camera.translation.x, p.in_camera.y + camera.translation.y,
                 p.in_camera.z + camera.translation.z};
  rotation_from_quaternion(row.quaternion, p);
  Matrix<V> axes = p.world_from_gaussian;
  for (auto& r : axes.rows) r = {r.x * row.scales.x, r.y * row.scales.y, r.z * row.scales.z};
  p.camera_from_gaussian = camera.rotation * axes;
  p.inverse_z = 1 / p.in_camera.z;
}

// The row's covariance on the screen.
template <class T, class V>
inline void project_shape(const Camera<T>& camera, Projection<V>& p) {
  const V slopes[2] = {p.in_camera.x * p.inverse_z, p.in_camera.y * p.inverse_z};
  for (int axis = 0; axis < 2; ++axis) {
    p.slope[axis] = limited(slopes[axis], camera.slope_min[axis], camera.slope_max[axis]);
    p.inside[axis] = p.slope[axis] == slopes[axis];
  }
  const Matrix<V>& m = p.camera_from_gaussian;
  p.factor_x = (camera.fx * p.inverse_z) * (m.rows[0] + -p.slope[0] * m.rows[2]);
  p.factor_y = (camera.fy * p.inverse_z) * (m.rows[1] + -p.slope[1] * m.rows[2]);
  const V xx = dot(p.factor_x, p.factor_x), yy = dot(p.factor_y, p.factor_y);
  const Vector<V> c = cross(p.factor_x, p.factor_y);
  // Cauchy-Binet: a sum of squares, so needles lose no digits and the determinant is never negative.
  p.bare_determinant = dot(c, c);
  p.determinant = p.bare_determinant + camera.blur * (xx + yy) + camera.blur * camera.blur;
  p.variance_x = xx + camera.blur, p.variance_y = yy + camera.blur, p.covariance = dot(p.factor_x, p.factor_y);
}

template <class T, class V>
inline V compensation(const Camera<T>& camera, const Projection<V>& p) {
  if (!camera.antialias) return V{} + T(1);
  const V ratio = p.bare_determinant / p.determinant, floor = V{} + T(COMPENSATION_FLOOR);
  return root(ratio > floor ? ratio : floor);
}

// Colour before the clamp at zero; also the unit direction, the distance and the basis for backward.
template <class V>
struct ViewColor {
  Vector<V> direction, raw;
  V distance, values[16];
};

template <class T, class V>
inline ViewColor<V> view_color(const Camera<T>& camera, const Vector<V>& in_camera, const V* sh, int64_t terms) {
  ViewColor<V> c;
  const Vector<V> ray = transposed(camera.rotation, in_camera);
  c.distance = root(dot(ray, ray));
  c.direction = (1 / c.distance) * ray;
  basis(c.direction, terms, c.values);
  const V middle = V{} + T(0.5);
  c.raw = {middle, middle, middle};
  for (int64_t k = 0; k < terms; ++k) c.raw = c.raw + c.values[k] * Vector<V>{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]};
  return c;
}

// First and last index whose pixel centre lies within [centre - half, centre + half], cut to [0, size); limited first,
// since the box of a giant does not fit an integer.
template <class T, class V>
inline void pixel_span(const V& centre, const V& half, T size, Index<V>& first, Index<V>& last) {
  first = ceiling(limited(centre - half - T(0.5), T(0), size));
  last = floored(limited(centre + half - T(0.5), T(-1), size - 1));
}

// The box of the ellipse alpha >= alpha_min: o exp(-q/2) >= alpha_min needs q <= 2 ln(o / alpha_min).
template <class T, class V>
inline void bound(const Camera<T>& camera, const Projection<V>& p, const V& opacity, Splat<V>& s) {
  s.log2_opacity = log2_positive<T>(opacity);
  s.least_exponent = V{} + camera.log2_alpha_min;
  if (camera.alpha_min > 0) {
    const V reach = positive_part(T(TWO_LN2) * log2_positive<T>(opacity / camera.alpha_min));
    s.half_x = root(reach * p.variance_x), s.half_y = root(reach * p.variance_y);
  } else {
    s.half_x = s.half_y = V{} + std::numeric_limits<T>::infinity();
  }
}

// Fills `s` but for its colour; answers which rows can touch a pixel. Comparisons are written so that NaN culls.
template <class T, class V>
inline Index<V> project(const Camera<T>& camera, const RowValues<V>& row, Projection<V>& p, Splat<V>& s) {
  place(camera, row, p);
  project_shape(camera, p);
  const V opacity = row.opacity * compensation(camera, p);
  bound(camera, p, opacity, s);
  s.x = camera.fx * p.in_camera.x * p.inverse_z + camera.cx;
  s.y = camera.fy * p.in_camera.y * p.inverse_z + camera.cy;
  s.depth = p.in_camera.z;
  const V box_x = s.half_x + T(BOX_MARGIN), box_y = s.half_y + T(BOX_MARGIN);
  pixel_span(s.y, box_y + T(1e-5) * s.half_y, camera.height, s.first_row, s.last_row);
  const T scale = T(LOG2_SCALE);
  const V deviation_y = root(p.variance_y), deviations = root(p.determinant);
  s.l11 = scale * root(p.variance_y / p.determinant);
  s.l21 = -scale * p.covariance / (deviation_y * deviations);
  s.l22 = scale / deviation_y;
  return p.in_camera.z > camera.near_plane && row.opacity > T(0) && p.determinant >= T(DETERMINANT_MIN) &&
         p.determinant <= std::numeric_limits<T>::max() && opacity >= camera.alpha_min && s.x + box_x >= T(0.5) &&
         s.x - box_x <= camera.width - T(0.5) && s.y + box_y >= T(0.5) && s.y - box_y <= camera.height - T(0.5);
}

}  // namespace SPLAT_VARIANT
