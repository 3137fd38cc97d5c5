// A Gaussian in the camera frame: its mean and its axes, and back.
#pragma once
#include "camera.hpp"

namespace SPLAT_VARIANT {

// The parameters of a row that do not depend on the view, or their gradients.
template <class V>
struct RowValues {
  Vector<V> mean, scales;
  V quaternion[4], opacity;
};

template <class V>
struct Placement {
  Vector<V> mean;
  V inverse_z;
  V quaternion[4], inverse_length;  // unit; inverse_length 0: a zero quaternion, replaced by the identity
  Matrix<V> rotation, axes;     // world from Gaussian; camera rotation times that times scales
};

// Gradients of mean and axes.
template <class V>
struct PlacementGradient {
  Vector<V> mean;
  Matrix<V> axes;
};

// By the largest component first: a squared length would leave T's range long before the length does. 1 / length stays
// below 1 / shortest, where it would leave it.
template <class V>
inline void rotation_from_quaternion(const V* given, Placement<V>& p) {
  using Limits = std::numeric_limits<Scalar<V>>;
  const V shortest = V{} + Limits::min() / Limits::epsilon();
  V largest = shortest, scaled[4], squared{};
  for (int i = 0; i < 4; ++i) largest = larger(largest, magnitude(given[i]));
  const V scale = 1 / largest;
  for (int i = 0; i < 4; ++i) scaled[i] = given[i] * scale, squared += scaled[i] * scaled[i];
  const auto usable = squared > V{};
  const V inverse = 1 / root(squared);
  p.inverse_length = usable ? smaller(scale * inverse, 1 / shortest) : V{};
  for (int i = 0; i < 4; ++i) p.quaternion[i] = usable ? scaled[i] * inverse : V{} + Scalar<V>(i == 0);
  const V w = p.quaternion[0], x = p.quaternion[1], y = p.quaternion[2], z = p.quaternion[3];
  p.rotation = {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                 {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                 {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}

template <class T, class V>
inline Placement<V> place(const Camera<T>& camera, const RowValues<V>& row) {
  Placement<V> p;
  // A difference of neighbors far from the origin is exact; R m + t would round two numbers of the world's size.
  const Vector<T>&c = camera.position, &rest = camera.position_rest;
  p.mean = camera.rotation *
           Vector<V>{(row.mean.x - c.x) - rest.x, (row.mean.y - c.y) - rest.y, (row.mean.z - c.z) - rest.z};
  p.inverse_z = 1 / p.mean.z;
  rotation_from_quaternion(row.quaternion, p);
  Matrix<V> axes = p.rotation;
  for (auto& r : axes.rows) r = {r.x * row.scales.x, r.y * row.scales.y, r.z * row.scales.z};
  p.axes = camera.rotation * axes;
  return p;
}

template <class V>
inline void quaternion_backward(const Placement<V>& p, const Matrix<V>& v, V* out) {
  const V w = p.quaternion[0], x = p.quaternion[1], y = p.quaternion[2], z = p.quaternion[3];
  const Vector<V>&a = v.rows[0], &b = v.rows[1], &c = v.rows[2];
  const V g[4] = {2 * (x * (c.y - b.z) + y * (a.z - c.x) + z * (b.x - a.y)),
                  2 * (w * (c.y - b.z) + y * (a.y + b.x) + z * (a.z + c.x)) - 4 * x * (b.y + c.z),
                  2 * (w * (a.z - c.x) + x * (a.y + b.x) + z * (b.z + c.y)) - 4 * y * (a.x + c.z),
                  2 * (w * (b.x - a.y) + x * (a.z + c.x) + y * (b.z + c.y)) - 4 * z * (a.x + b.y)};
  const V along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
  for (int i = 0; i < 4; ++i) out[i] = (g[i] - along * p.quaternion[i]) * p.inverse_length;
}

// Fills the gradients of mean, quaternion and scales.
template <class T, class V>
inline void place_backward(const Camera<T>& camera, const RowValues<V>& row, const Placement<V>& p,
                           const PlacementGradient<V>& g, RowValues<V>& out) {
  out.mean = transposed(camera.rotation, g.mean);
  const Vector<T>&x = camera.rotation.rows[0], &y = camera.rotation.rows[1], &z = camera.rotation.rows[2];
  const Vector<V>* v = g.axes.rows;
  Matrix<V> v_axes{{x.x * v[0] + y.x * v[1] + z.x * v[2], x.y * v[0] + y.y * v[1] + z.y * v[2],
                    x.z * v[0] + y.z * v[1] + z.z * v[2]}};  // in the world
  out.scales = Vector<V>{};
  for (int i = 0; i < 3; ++i) {
    const Vector<V>& r = p.rotation.rows[i];
    Vector<V>& a = v_axes.rows[i];
    out.scales = out.scales + Vector<V>{a.x * r.x, a.y * r.y, a.z * r.z};
    a = {a.x * row.scales.x, a.y * row.scales.y, a.z * row.scales.z};
  }
  quaternion_backward(p, v_axes, out.quaternion);
}

}  // namespace SPLAT_VARIANT
