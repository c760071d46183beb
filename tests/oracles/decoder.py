"""Decodes `.tcgs` files of versions 1.0 to 1.3: an independent implementation, written from FORMAT.md without a look at the program, in plain
Python. Prints for each file the decode hash that it computed, and fails where that is not the one which the file states.

    python3 tests/oracles/decoder.py FILE...
"""
import struct,hashlib,sys,math
from fractions import Fraction
M64=(1<<64)-1
def f32(x): return struct.unpack('<f',struct.pack('<f',x))[0]
class R:
    def __init__(s,b): s.b=b;s.p=0
    def take(s,n):
        assert s.p+n<=len(s.b); r=s.b[s.p:s.p+n]; s.p+=n; return r
    def u8(s): return s.take(1)[0]
    def u16(s): return struct.unpack('<H',s.take(2))[0]
    def u32(s): return struct.unpack('<I',s.take(4))[0]
    def u64(s): return struct.unpack('<Q',s.take(8))[0]
    def f32(s): return struct.unpack('<f',s.take(4))[0]
    def varint(s):
        v=0;sh=0
        while True:
            c=s.u8(); v|=(c&127)<<sh; sh+=7
            if not c&128: return v
    def signed(s):
        z=s.varint(); return (z>>1)^-(z&1)
    def text(s): n=s.varint(); return s.take(n).decode()
    def rest(s): r=s.b[s.p:]; s.p=len(s.b); return r
class RC:
    def __init__(s,b):
        s.b=b; s.lower=0; s.range=M64; s.pos=8; s.fetch=0
        s.point=int.from_bytes((b[:8]+bytes(8))[:8],'big'); s.n=0
    def quant(s,P):
        s.scale=s.range>>P
        q=((s.point-s.lower)&M64)//s.scale
        assert q<(1<<P); return q
    def consume(s,start,count):
        s.n+=1
        s.lower=(s.lower+s.scale*start)&M64
        s.range=s.scale*count
        if s.range<1<<32:
            s.lower=(s.lower<<32)&M64; s.range=(s.range<<32)&M64
            s.fetch+=1
            assert len(s.b)>=4*s.fetch
            nb=(s.b[s.pos:s.pos+4]+bytes(4))[:4]; s.pos+=4
            s.point=((s.point<<32)|int.from_bytes(nb,'big'))&M64
    def bit(s,p):
        q=s.quant(16); z=(1<<16)-p
        if q<z: s.consume(0,z); return 0
        s.consume(z,p); return 1
    def even(s): return s.bit(1<<15)
    def end(s):
        if s.n==0: assert s.b==b'' ; return
        for n in range(9):
            m=1<<(64-8*n); v=(-(-s.lower//m)*m)&M64
            if ((v-s.lower)&M64)<s.range: break
        assert len(s.b)==4*s.fetch+n,(len(s.b),s.fetch,n)
        assert s.point==v,(s.point,v)
class Ctx:
    def __init__(s): s.d={}
    def bit(s,rc,key):
        st=s.d.setdefault(key,[1<<21,0])
        p=min(max(st[0]>>6,32),65504)
        b=rc.bit(p)
        num=b*(1<<22)-st[0]; den=st[1]+2
        q=abs(num)//den; q=q if num>=0 else -q
        st[0]+=q; st[1]=min(st[1]+1,510)
        return b
# gaussians
INV=[round(2**((816-7*s)/32)) for s in range(64)]
import decimal
decimal.getcontext().prec=60
def tail(i):
    # 2^32*(1-Phi(i/64)) high precision via erfc series
    x=decimal.Decimal(i)/64
    # integrate: Phi(x)-0.5 = 1/sqrt(2pi) * sum
    pi=decimal.Decimal('3.14159265358979323846264338327950288419716939937510582097494459')
    s=decimal.Decimal(0);t=x;n=0
    while abs(t)>decimal.Decimal(10)**-55:
        s+=t/(2*n+1); n+=1; t=-t*x*x/(2*n)
    ph=s/(2*pi).sqrt()
    v=(decimal.Decimal(1)/2-ph)*(1<<32)
    return int(v.to_integral_value(rounding=decimal.ROUND_HALF_EVEN))
TAIL=[tail(i) for i in range(449)]
h=hashlib.sha256(b''.join(struct.pack('<I',t) for t in TAIL)).hexdigest()
assert h=='bea455f39cc6e24dc9adbd1b6fd8aa96191ab7c9e5f073a6cdf20f6b3a99e323',h
assert INV[0]==47453133 and INV[63]==3371
def phi(x):
    a=abs(x); i=a>>20; f=a&((1<<20)-1)
    t=0 if i>=448 else TAIL[i]-(((TAIL[i]-TAIL[i+1])*f)>>20)
    return t if x<0 else (1<<32)-t
TB={}
def table(m,s):
    h=m%16
    k=(h,s)
    if k not in TB:
        Rr=(11*2**21)//INV[s]+2
        edge=lambda d: phi((16*d-h-8)*INV[s])
        free=(1<<24)-(2*Rr+2); e0=edge(-Rr)
        TB[k]=(Rr,[(d+Rr)+(((edge(d)-e0)*free)>>32) for d in range(-Rr,Rr+2)])
    return TB[k]
import bisect
def gauss(rc,m,s):
    Rr,st=table(m,s); c=m>>4
    q=rc.quant(24)
    i=bisect.bisect_right(st,q)-1
    if i<2*Rr+1:
        rc.consume(st[i],st[i+1]-st[i]); return c+i-Rr
    rc.consume(st[-1],(1<<24)-st[-1])
    neg=rc.even(); n=0
    while rc.even(): n+=1; assert n<=26
    v=1
    for _ in range(n): v=v*2+rc.even()
    d=v+Rr
    return c+(-d if neg else d)
def dist(r): m=r.signed(); k=r.u8(); assert k<=64; return (m,k)
def sym(rc,d): return d[0] if d[1]==64 else gauss(rc,*d)
def decode(b):
    r=R(b); assert r.take(8)==b'\x89TCGS\r\n\x1a'
    maj,mi,S,prof=r.u16(),r.u16(),r.u16(),r.u16(); L=r.u64(); sha=r.take(32); crc=r.u32()
    assert L==len(b) and hashlib.sha256(b[:24]+b[60:]).digest()==sha
    sec={}
    for _ in range(S):
        i=r.take(4); fl=r.u32(); o=r.u64(); l=r.u64(); r.u32(); sec[i.decode()]=b[o:o+l]
    m=R(sec['MANI'])
    N,G,F,K,per=[m.varint() for _ in range(5)]
    vox=m.f32(); org=[m.f32() for _ in range(3)]; base=[m.f32() for _ in range(3)]
    ctx=[]
    for _ in range(3):
        ctx.append(m.u8()); [m.varint() for _ in range(4)]
    m.u8();m.u8();m.u8(); dh=m.take(32); gen=m.text()
    if m.u8(): m.take(32)
    if m.u8(): m.text()
    m.text(); assert m.p==len(m.b)
    # nets
    degree=1
    if 'DIRS' in sec: degree,=sec['DIRS']; assert degree in (2,3)
    n=R(sec['NETS']); heads=[]
    for outs in (K,7*K,3*K):
        ls=[];inp=F+(4,9,16)[degree-1]
        for _ in range(n.varint()):
            o=n.varint(); bs=n.f32(); ds=[dist(n) for _ in range(3)]; ls.append((inp,o,bs,ds)); inp=o
        assert inp==outs; heads.append(ls)
    rc=RC(n.rest()); nets=[]
    for ls in heads:
        net=[]
        for inp,o,bs,ds in ls:
            sc=[struct.unpack('<f',struct.pack('<I',sym(rc,ds[0])<<16))[0] for _ in range(o)]
            w=[f32(sym(rc,ds[1])*sc[row]) for row in range(o) for _ in range(inp)]
            bi=[f32(sym(rc,ds[2])*bs) for _ in range(o)]
            net.append((inp,o,w,bi))
        nets.append(net)
    rc.end()
    # cells
    c=R(sec['CELL']); low=[c.signed() for _ in range(3)]; D=c.u8(); rc=RC(c.rest()); C=Ctx(); C1=Ctx(); C2=Ctx()
    def de(code):
        v=[0,0,0]
        for bt in range(22):
            for a in range(3): v[a]|=((code>>(3*bt+a))&1)<<bt
        return tuple(v)
    def il(v):
        x=0
        for bt in range(22):
            for a in range(3): x|=((v[a]>>bt)&1)<<(3*bt+a)
        return x
    nodes=[0]
    for l in range(D):
        h=D-1-l; st=set(nodes); nxt=[]
        for nd in nodes:
            p=de(nd)
            def ex(a,s):
                q=list(p); q[a]+=s
                if q[a]<0 or q[a]>=1<<l: return 0
                return int(il(q) in st)
            sd={(a,s):ex(a,s) for a in range(3) for s in(-1,1)}
            one=C.bit(rc,(min(h,7),sum(sd.values())))
            if one:
                j=0;kn=()
                for a in (2,1,0):
                    bt=C1.bit(rc,(min(h,2),a,sd[a,-1],sd[a,1],kn)); kn+=(bt,); j|=bt<<a
                nxt.append(8*nd+j)
            else:
                have=[]
                for j in range(8):
                    # forced if otherwise fewer than two possible
                    if len(have)+(8-j)<=2 and len(have)+(7-j)<2: b_=1
                    else:
                        c2=sum(1 for a in range(3) if j>>a&1 and (j-(1<<a)) in have)
                        away=sum(sd[a,-1 if j>>a&1 else 1] for a in range(3))
                        tou=sum(sd[a,1 if j>>a&1 else -1] for a in range(3))
                        b_=C2.bit(rc,(h==0,j,min(len(have),3),c2,away,tou))
                    if b_: have.append(j); nxt.append(8*nd+j)
        nodes=nxt
    rc.end(); assert len(nodes)==N
    cells=[tuple(low[a]+de(x)[a] for a in range(3)) for x in nodes]
    # masks
    rc=RC(sec['MASK']); C=Ctx(); prev=[1]*K; masks=[]
    share=lambda a,b:3 if a==b else 3*a//b
    for _ in range(N):
        cur=[]
        for k in range(K):
            if k==K-1 and not any(cur): cur.append(1); continue
            cur.append(C.bit(rc,(k,prev[k],share(sum(cur),k),share(sum(prev),K))))
        masks.append(cur); prev=cur
    rc.end(); assert sum(map(sum,masks))==G
    # context
    widths=[F,6,3*K]; preds=[None]*3
    FACT=[f32(2**(7*j/32)) for j in range(-16,17)]
    RAT=[round(2**(16-7*j/32)) for j in range(-16,17)]
    if any(ctx):
        x=R(sec['CTXT']); cen=[x.signed() for _ in range(3)]; half=[x.varint() for _ in range(3)]
        td=lambda a,b:(abs(a)//abs(b))*(1 if (a<0)==(b<0) else -1)
        cl=lambda v,l,hh:max(l,min(hh,v))
        vs=[]
        for ce in cells:
            u=[cl(td((ce[a]-cen[a])<<16,half[a]),-(1<<26),1<<26) for a in range(3)]
            nn=math.isqrt(sum(q*q for q in u))
            if nn>1<<16:
                rr=td((2*nn-(1<<16))<<16,nn); u=[td(q*rr,nn) for q in u]
            vs.append([cl(q,-(1<<17),1<<17) for q in u])
        def position(v):
            out=[]
            for q in v:
                out.append(q>>8)
                for k in range(1,6): out.append((abs(((q<<k)%(1<<18))-(1<<17))-(1<<16))>>8)
            return out
        planes=None
        if 'PLAN' in sec:
            y=R(sec['PLAN']); e=y.varint(); ch=y.varint(); nl=y.varint(); ls=[]; cin=ch
            for _ in range(nl):
                o=y.varint(); ls.append((cin,o,[dist(y) for _ in range(3)])); cin=o
            rc=RC(y.rest()); L2=[]
            for i,o,ds in ls:
                sh=[sym(rc,ds[0]) for _ in range(o)]; w=[sym(rc,ds[1]) for _ in range(i*o*9)]; bi=[sym(rc,ds[2]) for _ in range(o)]
                L2.append((i,o,sh,w,bi))
            CA,CB,CC,CD=Ctx(),Ctx(),Ctx(),Ctx()
            dg=lambda v:abs(v).bit_length(); sg=lambda v:(v>0)-(v<0)
            planes=[]
            for pl in range(3):
                chs=[]
                for c_ in range(ch):
                    pr=CA.bit(rc,0); im=[[0]*e for _ in range(e)]; re=[[0]*e for _ in range(e)]
                    for Y in range(e):
                        for X in range(e):
                            Lr=re[Y][X-1] if X else 0; A=re[Y-1][X] if Y else 0
                            ctxd=dg((abs(Lr)+abs(A)+1)>>1)
                            d=0
                            while d<8 and CB.bit(rc,(ctxd,d)): d+=1
                            v=0
                            if d:
                                ng=CC.bit(rc,(sg(Lr),sg(A))); v=1
                                for pp in range(d-2,-1,-1): v=v*2+CD.bit(rc,(d,pp))
                                if ng: v=-v
                            re[Y][X]=v
                            if pr and (X or Y):
                                if X and Y: pd=(im[Y][X-1]+im[Y-1][X])>>1
                                elif X: pd=im[Y][X-1]
                                else: pd=im[Y-1][X]
                            else: pd=0
                            im[Y][X]=v+pd; assert abs(im[Y][X])<=127
                    chs.append([[16*q for q in row] for row in im])
                planes.append(chs)
            rc.end(); E=e
            for li,(i,o,sh,w,bi) in enumerate(L2):
                new=[]
                for pl in planes:
                    oc=[]
                    for oo in range(o):
                        acc=[[0]*(2*E) for _ in range(2*E)]
                        for ii in range(i):
                            for yy in range(E):
                                for xx in range(E):
                                    val=pl[ii][yy][xx]
                                    for v_ in range(3):
                                        for u_ in range(3):
                                            Xo,Yo=2*xx+u_-1,2*yy+v_-1
                                            if 0<=Xo<2*E and 0<=Yo<2*E: acc[Yo][Xo]+=w[((ii*o+oo)*3+v_)*3+u_]*val
                        s_=sh[oo]; lo,hi=(0,(1<<14)-1) if li+1<len(L2) else (-(1<<14)+1,(1<<14)-1)
                        oc.append([[cl(((a+((1<<(s_-1)) if s_ else 0))>>s_)+bi[oo],lo,hi) for a in row] for row in acc])
                    new.append(oc)
                planes=new; E*=2
            PR=E
        def sample(v):
            t=[((q+(1<<17))*(PR-1))>>10 for q in v]
            out=[]
            for pl,(a0,a1) in enumerate(((0,1),(1,2),(0,2))):
                x0,fx=t[a0]>>8,t[a0]&255; y0,fy=t[a1]>>8,t[a1]&255
                x1=min(x0+1,PR-1); y1=min(y0+1,PR-1)
                for p in planes[pl]:
                    out.append((p[y0][x0]*(256-fx)*(256-fy)+p[y0][x1]*fx*(256-fy)+p[y1][x0]*(256-fx)*fy+p[y1][x1]*fx*fy)>>16)
            return out
        for g in range(3):
            if not ctx[g]: continue
            ln=x.varint(); q=R(x.take(ln)); Bw=q.u8(); nl=q.varint(); ls=[]
            inp=18 if ctx[g]==1 else 18+3*len(planes[0])*(1 if ctx[g]==2 else 4)
            for _ in range(nl):
                o=q.varint(); ls.append((inp,o,[dist(q) for _ in range(3)])); inp=o
            rc=RC(q.rest()); net=[]
            for i,o,ds in ls:
                sh=[sym(rc,ds[0]) for _ in range(o)]; w=[sym(rc,ds[1]) for _ in range(i*o)]; bi=[sym(rc,ds[2]) for _ in range(o)]
                net.append((i,o,sh,w,bi))
            rc.end(); P=[]
            for a in range(N):
                if ctx[g]==1: z=position(vs[a])
                elif ctx[g]==2: z=sample(vs[a])+position(vs[a])
                else:
                    dd=sorted((sum((cells[a][k]-cells[o_][k])**2 for k in range(3)),o_) for o_ in range(N) if o_!=a)[:3]
                    nb=[o_ for _,o_ in dd]+[a]*(3-len(dd))
                    z=sample(vs[a])+sum((sample(vs[o_]) for o_ in nb),[])+position(vs[a])
                for li,(i,o,sh,w,bi) in enumerate(net):
                    last=li+1==len(net); lo,hi=(-(1<<23),1<<23) if last else (0,(1<<14)-1)
                    z=[cl(((sum(w[r_*i+k]*z[k] for k in range(i))+((1<<(sh[r_]-1)) if sh[r_] else 0))>>sh[r_])+bi[r_],lo,hi) for r_ in range(o)]
                W=widths[g]; j=cl((z[2*W]*1170+(1<<15))>>16,-16,16)
                P.append((j,[(cl((z[k]*RAT[j+16]+(1<<19))>>20,-(1<<28),1<<28),cl(((z[W+k]*1170+(1<<15))>>16)+16-j,0,63)) for k in range(W)]))
            preds[g]=P
        assert x.p==len(x.b)
    a=R(sec['ATTR']); stat=[None]*3
    for g in range(3):
        if not ctx[g]: j=a.signed(); stat[g]=(j,[dist(a) for _ in range(widths[g])])
    regr=[None]*3
    if 'REGR' in sec:
        q=R(sec['REGR']); flags=q.u8(); assert 1<=flags<=7
        for g in range(3):
            if not flags>>g&1: continue
            regr[g]=[]
            for c in range(widths[g]):
                k=q.varint(); assert k<=1<<15
                if k==0: regr[g].append(None); continue
                t=q.signed(); sl=q.signed(); w=[q.signed() for _ in range(c)]
                assert abs(t)<=1<<24 and abs(sl)<=1<<15 and all(abs(x)<=1<<15 for x in w)
                regr[g].append((k,t,sl,w))
        assert q.p==len(q.b)
        assert sum(widths[g]**2//2 for g in range(3) if regr[g])*N<=1<<38
    def corrected(d,reg,res):
        if reg is None or d[1]==64: return d
        k,t,sl,w=reg; m,s=d
        M=max(-(1<<28),min(1<<28,m+t+((sum(x*y for x,y in zip(w,res))+128)>>8)))
        V=max(1,min(1<<36,((k*((1<<34)//INV[s]))>>8)+sl*(M-m)))
        return M,next((i for i in range(64) if V*INV[i]<=1<<34),63)
    nch=-(-N//per); idx=[]
    for _ in range(nch):
        idx.append([a.varint() for _ in range(3)]); a.u32()
    vals=[[],[],[]]
    for ci in range(nch):
        for g in range(3):
            rc=RC(a.take(idx[ci][g]))
            for an in range(ci*per,min(N,(ci+1)*per)):
                j,ds=preds[g][an] if preds[g] else stat[g]
                step=f32(base[g]*FACT[j+16]); row=[]
                res=[]
                for k in range(widths[g]):
                    if g==2 and not masks[an][k//3]: row.append(0.0); res.append(0); continue
                    v=sym(rc,corrected(ds[k],regr[g][k],res) if regr[g] else ds[k])
                    res.append(0 if ds[k][1]==64 else 16*v-ds[k][0])
                    row.append(f32(v*step)+0.0)
                vals[g].append(row)
            rc.end()
    assert a.p==len(a.b)
    H=hashlib.sha256(); H.update(struct.pack('<QQQf3f',N,F,K,vox,*org))
    for s in range(0,N,4096):
        e=min(N,s+4096); q=hashlib.sha256()
        q.update(b''.join(struct.pack('<3i',*cells[i]) for i in range(s,e)))
        for g in range(3): q.update(b''.join(struct.pack('<%df'%widths[g],*vals[g][i]) for i in range(s,e)))
        q.update(b''.join(bytes(masks[i]) for i in range(s,e))); H.update(q.digest())
    for net in nets:
        H.update(struct.pack('<Q',len(net)))
        for i,o,w,bi in net: H.update(struct.pack('<QQ',i,o)+struct.pack('<%df'%len(w),*[v+0.0 for v in w])+struct.pack('<%df'%len(bi),*[v+0.0 for v in bi]))
    scene=dict(K=K,degree=degree,positions=[[f32(f32(c*vox)+o) for c,o in zip(cell,org)] for cell in cells],features=vals[0],scalings=vals[1],offsets=vals[2],masks=masks,networks=nets)
    return H.hexdigest(),dh.hex(),scene
def main():
    for f in sys.argv[1:]:
        with open(f,'rb') as file: found,stated,_=decode(file.read())
        print(found,f.split('/')[-1])
        if found!=stated: sys.exit(f'{f} states {stated}')
if __name__=='__main__': main()
