// Memory that grows and is reused between calls; never initialized, so nothing may be read before it was written.
#pragma once
#include <cstdint>
#include <cstring>
#include <new>

namespace SPLAT_VARIANT {

template <class Element>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { release(); }

  // Room for `count` elements; the contents are lost when it grows.
  Element* reserve(int64_t count) {
    if (count > capacity_) {
      release();
      // A quarter more than asked for: counts drift by a few per cent from view to view.
      const int64_t wanted = count + count / 4 + 64;
      data_ = static_cast<Element*>(::operator new(wanted * sizeof(Element), std::align_val_t{64}));
      capacity_ = wanted;
    }
    return data_;
  }
  Element& operator[](int64_t i) { return data_[i]; }
  const Element& operator[](int64_t i) const { return data_[i]; }
  int64_t bytes() const { return capacity_ * int64_t(sizeof(Element)); }
  // For tests: every byte 0xff is NaN as a float and -1 as an integer.
  void poison() {
    if (data_) std::memset(static_cast<void*>(data_), 0xff, bytes());
  }

 private:
  void release() {
    if (data_) ::operator delete(static_cast<void*>(data_), std::align_val_t{64});
    data_ = nullptr;
    capacity_ = 0;
  }
  Element* data_ = nullptr;
  int64_t capacity_ = 0;
};

}  // namespace SPLAT_VARIANT
